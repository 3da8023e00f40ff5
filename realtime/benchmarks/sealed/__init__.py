"""A benchmark of tools that explain stops: sets without truth, a key apart, answers by any tool, one judge."""
