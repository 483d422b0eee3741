"""The paper's experiments: many trials, one row each, and reports on the rows."""
