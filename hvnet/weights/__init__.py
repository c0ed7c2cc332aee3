"""The weights that come with the package, and how they were made: docs/model_card.md says what they are for."""
