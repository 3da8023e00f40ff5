"""The paper's own tuning and validation, and fits of measured creep curves."""
