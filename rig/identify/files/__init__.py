"""Reads tables that loggers write: forms of CSV, Parquet, units, stamps, and names of columns."""
