"""The paper's experiments: many trials, one row each, and what the rows say."""
