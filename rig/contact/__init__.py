"""Wheel-rail and wheel-roller contact.

Reading order: `profiles` and `geometry` (where wheel and rail touch), `hertz` and `kalker` (size and linear creep
coefficients of the `patch`), `polach` (creep force along the rail), `adhesion` (degraded adhesion that recovers with
the energy dissipated in sliding: the law, for all who need it); then in two directions with spin `johnson_vermeulen`,
`fastsim` and `polach_spin` behind the one interface of `creep_force`.
"""
