"""Files for a shell: completion of command lines, and a manual page."""
