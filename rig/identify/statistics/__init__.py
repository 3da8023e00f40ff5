"""Statistics of small sets of data: robust lines, resampling, tests by simulation, and intervals.

`interval` has the rule for every finding: it is reported if and only if its interval excludes
"nothing" at the family-wise level.
"""
