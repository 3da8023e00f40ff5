"""The spin moment of the models that give only a force.

At small creepage the moment is Kalker's: one part from lateral creepage, because traction grows
towards the trailing edge, and one from spin. The first vanishes as the patch goes over to full
sliding, the second goes to that of a patch turning on the spot and falls with creepage.

[Z1] M = m_eta (1 - F_jv / (mu N))^0.7 - m_phi / sqrt(1 + (m_phi / m_max)^2 + (F_lin / (mu N))^2)
[Z2] m_eta = G (a b)^1.5 c23 eta, m_phi = G (a b)^2 c33 phi, m_max = 0.58 mu N sqrt(a b)
[Z3] F_lin = G a b hypot(c11 xi, c22 eta), F_jv the force that Johnson and Vermeulen make of it

Source: Kalker 1967 for [Z2]; the shape [Z1] is ours, read off 54 results of CONTACT for a/b = 1.3
(mean error 0.026, largest 0.18 mu N sqrt(a b)). Limits: other shapes of the patch are not checked.
"""

import math

from rollerrig.rig.kernel import kernel_inlined

TURNING = 0.58  # m_max over mu N sqrt(a b); 0.589 for a Hertzian circle on the spot (3 pi / 16)
FADE = 0.7


@kernel_inlined
def moment(xi, eta, phi_1_m, limit_N, a_m, b_m, patch):
    """Moment in N m on the wheel [Z1] for limit_N = mu N > 0, spin phi_1_m, semi-axes a_m and b_m."""
    if eta == 0.0 and phi_1_m == 0.0:
        return 0.0
    ab = a_m * b_m
    size, stiff = math.sqrt(ab), patch.shear_Pa * ab
    x, y = patch.c11 * xi, patch.c22 * eta
    linear = stiff / limit_N * math.sqrt(x * x + y * y)
    from_spin = stiff * ab * patch.c33 * phi_1_m
    turning = from_spin / (TURNING * limit_N * size)
    total = -from_spin / math.sqrt(1.0 + turning * turning + linear * linear)
    if linear < 3.0 and eta != 0.0:
        # 1 - (u - u^2 / 3 + u^3 / 27) = (1 - u / 3)^3
        total += stiff * size * patch.c23 * eta * (1.0 - linear / 3.0) ** (3.0 * FADE)
    return total
