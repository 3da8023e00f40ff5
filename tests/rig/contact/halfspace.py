"""Steady rolling of two equal elastic half-spaces: a reference for the creep force models.

Tractions on a grid over the contact ellipse strain both bodies by Cerruti's solution for a loaded
rectangle. Where the patch sticks, rigid creepage and strain cancel. Where it slips, the traction is
at the friction limit and against the slip. Newton's method with an active set solves this, as in
Kalker's TANG. The solution shares no line with the models under test, and is within 0.04 mu N of
CONTACT on 21 x 21 elements for a/b = 1.3.

The error is proportional to the size of the elements. On long patches with spin it reaches
0.1 mu N on 21 x 21 elements. `extrapolated_force` removes it with a second, coarser grid.

Source: Johnson, Contact Mechanics, 1985, sections 3.6 and 8.3; Kalker 1990, chapter 4.
"""

import math

import numpy as np


def _log(along, across):
    """Return log(along + rho), without cancellation where along is negative."""
    rho = np.hypot(along, across)
    return np.where(along > 0.0, np.log(along + rho), np.log(across * across / (rho - along)))


def _over_rectangle(primitive, x, y, hx, hy):
    return sum(
        sx * sy * primitive(x + 0.5 * sx * hx, y + 0.5 * sy * hy)
        for sx in (1, -1)
        for sy in (1, -1)
    )


def _displacements(x, y, hx, hy, shear_Pa, poisson):
    """Return the displacements (xx, xy, yy) at (x, y) by unit tractions on a rectangle at 0."""
    along = _over_rectangle(lambda x, y: y * _log(x, y), x, y, hx, hy)
    across = _over_rectangle(lambda x, y: x * _log(y, x), x, y, hx, hy)
    mixed = _over_rectangle(lambda x, y: -np.hypot(x, y), x, y, hx, hy)
    unit = 1.0 / (math.pi * shear_Pa)
    return (
        unit * (along + (1.0 - poisson) * across),
        unit * poisson * mixed,
        unit * (across + (1.0 - poisson) * along),
    )


def extrapolated_force(coarse, fine, xi, eta, phi_1_m, limit_N):
    """Return the force on the wheel over mu N (2,) on infinitely small elements.

    `coarse` and `fine` are `HalfSpace`s of one contact. The error falls with 1/n (Richardson).
    """
    coarse_force = coarse.force(xi, eta, phi_1_m, limit_N)
    fine_force = fine.force(xi, eta, phi_1_m, limit_N)
    share = coarse.n / (fine.n - coarse.n)
    return fine_force + share * (fine_force - coarse_force)


class HalfSpace:
    """A contact ellipse of semi-axes a_m along and b_m across, on n x n elements, n odd."""

    def __init__(self, a_m, b_m, shear_Pa, poisson, n=15):
        self.n = n
        hx = 2.0 * a_m / n
        hy = 2.0 * b_m / n
        middle = (2.0 * np.arange(n) + 1.0) / n - 1.0
        x, y = np.meshgrid(middle * a_m, middle * b_m, indexing="ij")
        inside = (x / a_m) ** 2 + (y / b_m) ** 2 < 1.0
        self.x = x[inside]
        self.y = y[inside]
        self.element_m2 = hx * hy
        self.bulge = np.sqrt(1.0 - (self.x / a_m) ** 2 - (self.y / b_m) ** 2)
        dx = np.subtract.outer(self.x, self.x)
        dy = np.subtract.outer(self.y, self.y)
        here = _displacements(dx, dy, hx, hy, shear_Pa, poisson)
        ahead = _displacements(dx + hx, dy, hx, hy, shear_Pa, poisson)
        xx, xy, yy = ((second - first) / hx for first, second in zip(here, ahead, strict=True))
        self.strain = np.block([[xx, xy], [xy, yy]])

    def force(self, xi, eta, phi_1_m, limit_N):
        """Return the force on the wheel over mu N, (along, across), for limit_N = mu N."""
        limit = limit_N * self.bulge / (self.bulge.sum() * self.element_m2)
        creep = np.concatenate((xi - phi_1_m * self.y, eta + phi_1_m * self.x))
        p = np.linalg.solve(self.strain, creep)
        slips = np.zeros(limit.size, dtype=bool)
        for _ in range(80):
            p = self._newton(p, creep, limit, slips)
            px, py = np.split(p, 2)
            sx, sy = np.split(creep - self.strain @ p, 2)
            begins = ~slips & (np.hypot(px, py) > limit * (1.0 + 1e-9))
            # elements stick again only after the slip area has stopped growing
            ends = slips & (px * sx + py * sy > 0.0) & (not begins.any())
            if not (begins.any() or ends.any()):
                return np.array([px.sum(), py.sum()]) * self.element_m2 / limit_N
            slips = (slips | begins) & ~ends
        raise ArithmeticError("stick and slip areas have not settled")

    def _newton(self, p, creep, limit, slips):
        """Return the tractions for given areas of stick and slip."""
        n = limit.size
        k = np.flatnonzero(slips)
        for _ in range(30):
            slip = creep - self.strain @ p
            rest = slip.copy()
            matrix = -self.strain.copy()
            px = p[k]
            py = p[n + k]
            sx = slip[k]
            sy = slip[n + k]
            g = limit[k]

            # where it slips: size of the traction, and its direction against the slip
            size = np.hypot(px, py)
            unit = g * np.hypot(sx, sy) + 1e-300
            rest[k] = size / g - 1.0
            rest[n + k] = (px * sy - py * sx) / unit
            matrix[k] = 0.0
            matrix[k, k] = px / (size * g)
            matrix[k, n + k] = py / (size * g)
            matrix[n + k] = (
                py[:, None] * self.strain[k] - px[:, None] * self.strain[n + k]
            ) / unit[:, None]
            matrix[n + k, k] += sy / unit
            matrix[n + k, n + k] -= sx / unit
            move = np.linalg.solve(matrix, -rest)
            p = p + move

            # back to the friction limit
            back = g / np.hypot(p[k], p[n + k])
            p[k] = p[k] * back
            p[n + k] = p[n + k] * back
            if np.abs(move).max() < 1e-6 * limit.max():
                break
        return p
