"""Tables of the paper that the project reproduces, and a study of measured stops with sand."""
