"""Which further stops would part the causes still possible."""
