"""Parts of the report of a train recording: pictures, and what could be judged."""
