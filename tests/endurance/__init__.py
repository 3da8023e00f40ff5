"""What a bench withstands: long runs, malformed input, and processes that are killed.

The bench is a separate process that is seen from outside; `runs` starts it and is read first.
"""
