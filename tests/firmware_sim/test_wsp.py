"""The reference WSP against a small coach of its own: four wheelsets on soap, valves with dead time.

The coach's equations are written here, apart from the project's physics: sliding, a saturated creep
force between a degraded and a recovered friction that the energy of sliding mixes, first-order air.
"""

import subprocess
import sys
from typing import NamedTuple

import numpy as np
import pytest
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import check
from rollerrig.firmware_sim import wsp
from rollerrig.firmware_sim.wsp_phases import Phase
from rollerrig.rig.kernel import kernel

RADIUS_M, INERTIA_KGM2, LOAD_N, MASS_KG = 0.445, 160.0, 105.4e3, 43e3
TORQUE_NM, DEAD_CYCLES, STEPS = 5300.0, 4, 10
DT_S = 0.01 / STEPS


@kernel
def adhesion(sliding_m_s, v_m_s, mu):
    """Contact force over load: the energy of sliding mixes degraded and recovered friction."""
    s = abs(sliding_m_s)
    e = s / max(v_m_s, 0.5)
    f_d = (mu + 1.5 * mu * np.exp(-0.2 * s)) * np.tanh(150.0 * e)
    f_r = (0.28 + 0.42 * np.exp(-0.6 * s)) * np.tanh(150.0 * e)
    k = 1.9e-4 * 0.5 * LOAD_N * e
    f = f_r
    for _ in range(8):
        decay = np.exp(-k * f)
        f -= (f - f_r + (f_r - f_d) * decay) / (1.0 - (f_r - f_d) * k * decay)
    return np.sign(sliding_m_s) * f


@kernel
def brake_coach(magnets, x, demand, mu):
    """One bus cycle of the coach. `x`: v, distance, then omega and pressure (0 to 1) of four axles."""
    for _ in range(STEPS):
        pull = 0.0
        for j in range(4):
            bits = (magnets >> (2 * j)) & 3
            if bits == 0:
                x[6 + j] += (demand - x[6 + j]) * DT_S / 0.3
            elif bits == 3:
                x[6 + j] -= x[6 + j] * DT_S / 0.2
            force = LOAD_N * adhesion(x[0] - RADIUS_M * x[2 + j], x[0], mu[j])
            rate = (RADIUS_M * force - TORQUE_NM * x[6 + j]) / INERTIA_KGM2
            x[2 + j] = max(0.0, x[2 + j] + rate * DT_S)
            pull += force
        x[0] = max(0.0, x[0] - pull / MASS_KG * DT_S)
        x[1] += x[0] * DT_S


@kernel
def stop(state, params, mu, log, protected):
    """Brake from 42 m/s until the coach stands; rows of v, four wheel speeds, reference, magnets."""
    x = np.zeros(10)
    x[0] = 42.0
    x[2:6] = 42.0 / RADIUS_M
    pipe = np.zeros(DEAD_CYCLES, np.int64)
    raw = np.zeros(4, np.int64)
    for i in range(log.shape[0]):
        for j in range(4):
            raw[j] = int(round(x[2 + j] * 100.0))
        magnets = wsp.step(state, raw, params)
        log[i, 0] = x[0]
        log[i, 1:5] = RADIUS_M * x[2:6]
        log[i, 5] = wsp.reference_raw(state) * 0.01
        log[i, 6] = magnets
        log[i, 7:11] = state.phase
        log[i, 11] = x[1]
        log[i, 12:16] = x[6:10]
        if x[0] < 0.05:
            return i
        brake_coach(pipe[i % DEAD_CYCLES] if protected else 0, x, 1.0 - np.exp(-i * 0.01 / 1.3),
                    mu[i])
        pipe[i % DEAD_CYCLES] = magnets
    return log.shape[0]
