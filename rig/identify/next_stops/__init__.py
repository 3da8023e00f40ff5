"""Which further stops would distinguish the causes that are still possible."""
