"""The adhesion law with the parameters of the paper's Table 4."""

from rollerrig.rig.contact.adhesion import Law

TABLE_4 = Law(
    mu_cd=0.06,
    mu_cr=0.28,
    A_d=0.40,
    A_r=0.40,
    gamma_d_s_m=0.20,
    gamma_r_s_m=0.60,
    k_ad=0.3,
    k_sd=0.1,
    k_ar=1.0,
    k_sr=0.4,
    tau_m_J=1.9e-4,
)
