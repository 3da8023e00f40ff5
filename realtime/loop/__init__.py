"""The hot path: clock, mailbox, ring, tick and the loop around it."""
