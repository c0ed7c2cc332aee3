"""Pictures of clouds, boxes and pseudo-images, the page of mistakes, and the viewer's page."""
