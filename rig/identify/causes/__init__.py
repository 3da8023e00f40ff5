"""The table of causes, what each adds to the replay, and explanations made of them."""
