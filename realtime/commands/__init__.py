"""The verbs of the command line: what each takes, does and prints."""
