"""Wheel-rail and wheel-roller contact.

Reading order: `profiles` and `geometry` (where wheel and rail touch), `hertz` (the patch), `kalker`
(linear creep coefficients), `polach` (creep force along the rail), `adhesion` (degraded adhesion
that recovers with the energy dissipated in sliding); then in two directions with spin
`johnson_vermeulen`, `fastsim`, `polach_spin` and `degraded_force`, with `creep_moment`, behind the
one interface of `creep_force`.
"""
