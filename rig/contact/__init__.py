"""Wheel-rail and wheel-roller contact.

Reading order: `profiles` and `geometry` (where wheel and rail touch), `hertz` and `kalker` (size
and linear creep coefficients of the `patch`), `polach` (creep force along the rail), `adhesion`
(the law of degraded adhesion, which recovers with the energy dissipated in sliding). Then come the
models in two directions with spin: `johnson_vermeulen`, `fastsim` and `polach_spin` behind the one
interface of `creep_force`. `vector_law` has the same laws for several wheels at a time,
`vector_secant` one of them with few divisions.
"""
