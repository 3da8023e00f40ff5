"""Wheel-rail and wheel-roller contact.

Reading order: `hertz` (the patch), `kalker` (linear creep coefficients), `polach` (creep force),
`adhesion` (degraded adhesion that recovers with the energy dissipated in sliding).
"""
