"""A run's folder: channels, records, summary, comparison, export."""
