"""The desk: a page from which the rig is run, watched, and asked about its runs; a process of its own.

Reading order: reader (what a bench's rings tell), doors (what a bench may be asked), lights, programs, library, desk
(these together), then the parts of the page: live, manual, automatic, runs; page puts them together, server serves it.
"""
