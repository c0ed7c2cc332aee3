"""The paper's tables and figures: what they are, their rows, and what is written."""
