"""The desk: a page from which an operator runs the rig, watches it and looks through its runs.

It is a separate process. Reading order: reader (the rings of a bench), doors (the commands of a
bench), lights, programs, library, desk (all of these together); then the parts of the page: vehicle
(parts that depend on the vehicle), live, manual, automatic, runs; page (which puts them together),
guard (which requests are answered) and server (which serves the page).
"""
