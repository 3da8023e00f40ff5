"""What a shell can be given beside the program: completion of command lines, and a manual page."""
