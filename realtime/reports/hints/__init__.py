"""Words that help a reader on: sizes in plain units, suspects, and what to measure next."""
