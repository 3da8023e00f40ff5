"""Configuration as data (TOML), the way to find it by name, and the errors that bad input raises.

Reading order: `errors`, `table` (parameters as rows), `store` (finding a file).
"""
