"""What a measured creep curve shows: whether friction falls, what it depends on, which law fits."""
