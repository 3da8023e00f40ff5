"""Configuration as data (TOML), how to find it by name, and the errors for wrong input.

Reading order: `errors`, `table` (parameters as rows), `store` (finding a file).
"""
