"""The sealed benchmark of tools that explain braking stops.

`cases` decides what is hidden in which set and writes the sets, without their truth, and the key.
`answers` lets a tool answer the sets, and reads the answers of any tool. `score` compares answers
with the key. `baselines` are three usual methods that answer the same sets, and `work` spreads the
sets over the cores.
"""
