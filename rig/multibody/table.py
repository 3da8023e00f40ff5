"""The numbers of the coach beyond those of [vehicle]: one table of rows, [multibody].

Inertias and stiffnesses are the paper's Tables 2 and 3; how many springs a bogie has, where they
stand, and the curves of dampers, bump-stops and traction rods are not printed: assumptions, marked.
A damper gives c v / sqrt(1 + (c v / F_max)^2): c at small speeds, F_max at large ones. A bump-stop
adds k_stop (|d| - gap)(1 + (|d| - gap) / 0.02 m) beyond its gap: rubber, half as stiff again at 10 mm.
"""

from rollerrig.configs.table import Row, choice, number

_T2, _T3, _A = "paper Table 2", "paper Table 3", "assumption"

ROWS: tuple[Row, ...] = (
    number("body_inertia_x_kgm2", 76400.0, 100.0, 1e7, _T2),
    number("body_inertia_y_kgm2", 1494400.0, 100.0, 1e8, _T2),
    number("body_inertia_z_kgm2", 1467160.0, 100.0, 1e8, _T2),
    number("bogie_inertia_x_kgm2", 2400.0, 10.0, 1e6, _T2),
    number("bogie_inertia_y_kgm2", 1900.0, 10.0, 1e6, _T2),
    number("bogie_inertia_z_kgm2", 4000.0, 10.0, 1e6, _T2),
    number("wheelset_inertia_x_kgm2", 800.0, 10.0, 1e5, _T2 + "; without axleboxes and links"),
    number("wheelset_inertia_z_kgm2", 800.0, 10.0, 1e5, _T2 + "; without axleboxes and links"),
    number("axlebox_mass_kg", 200.0, 0.0, 2000.0, _T2),
    number("axlebox_inertia_x_kgm2", 3.0, 0.0, 1e3, _T2),
    number("axlebox_inertia_y_kgm2", 12.0, 0.0, 1e3, _T2),
    number("axlebox_inertia_z_kgm2", 12.0, 0.0, 1e3, _T2),
    number("link_mass_kg", 60.0, 0.0, 1000.0, _T2),
    number("link_inertia_x_kgm2", 0.5, 0.0, 1e3, _T2),
    number("link_inertia_y_kgm2", 4.0, 0.0, 1e3, _T2),
    number("link_inertia_z_kgm2", 4.0, 0.0, 1e3, _T2),
    number("primary_x_N_m", 844000.0, 1e3, 1e9, _T3 + "; two a wheelset: assumption"),
    number("primary_y_N_m", 844000.0, 1e3, 1e9, _T3),
    number("primary_z_N_m", 790000.0, 1e3, 1e9, _T3),
    number("primary_roll_Nm_rad", 10700.0, 0.0, 1e7, _T3 + "; about y the axlebox turns with the frame"),
    number("secondary_x_N_m", 124000.0, 0.0, 1e8, _T3 + "; two a bogie: assumption"),
    number("secondary_y_N_m", 124000.0, 0.0, 1e8, _T3),
    number("secondary_z_N_m", 340000.0, 1e3, 1e8, _T3),
    number("anti_roll_bar_Nm_rad", 2.5e6, 0.0, 1e9, _T3 + "; one a bogie"),
    number("primary_half_width_m", 1.0, 0.1, 2.0, _A),
    number("secondary_half_width_m", 1.0, 0.1, 2.0, _A),
    number("secondary_height_m", 0.9, 0.1, 3.0, _A + "; middle of the spring, above the rail"),
    number("primary_damper_N_s_m", 8.0e3, 0.0, 1e6, _A + "; vertical, two a wheelset"),
    number("primary_damper_max_N", 6.0e3, 1.0, 1e6, _A),
    number("secondary_damper_N_s_m", 13.5e3, 0.0, 1e6, _A + "; vertical, two a bogie"),
    number("secondary_damper_max_N", 8.0e3, 1.0, 1e6, _A),
    number("lateral_damper_N_s_m", 25.0e3, 0.0, 1e6, _A + "; one a bogie"),
    number("lateral_damper_max_N", 12.0e3, 1.0, 1e6, _A),
    number("lateral_damper_height_m", 0.8, 0.1, 3.0, _A),
    number("yaw_damper_N_s_m", 250.0e3, 0.0, 1e7, _A + "; longitudinal, two a bogie"),
    number("yaw_damper_max_N", 12.0e3, 1.0, 1e6, _A),
    number("yaw_damper_half_width_m", 1.4, 0.1, 2.0, _A),
    number("yaw_damper_height_m", 0.9, 0.1, 3.0, _A),
    number("lateral_stop_gap_m", 0.025, 0.0, 0.2, _A + "; bogie to body"),
    number("lateral_stop_N_m", 1.0e6, 0.0, 1e9, _A),
    number("vertical_stop_gap_m", 0.040, 0.0, 0.2, _A + "; in the secondary springs, both ways"),
    number("vertical_stop_N_m", 2.0e6, 0.0, 1e9, _A),
    number("traction_rod_N_m", 5.0e6, 1e4, 1e9, _A + "; one a bogie, at the pivot's height"),
    number("traction_rod_damping_N_s_m", 3.0e4, 0.0, 1e6, _A + "; its rubber"),
    number("traction_rod_stop_gap_m", 0.010, 0.0, 0.2, _A),
    number("traction_rod_stop_N_m", 2.0e7, 0.0, 1e9, _A),
    number("contact_damping_N_s_m", 1.0e5, 0.0, 1e7, "paper Table 4; while wheel and rail approach"),
    number("laying", 0.05, 0.0, 0.2, "paper: rails inclined 1:20"),
    number("gauge_m", 1.435, 0.5, 2.0, "paper"),
    number("running_circles_m", 1.5, 0.5, 2.0, "paper: wheelset width"),
    choice("wheel_profile", "s1002", (), "s1002, or a CSV file of s_mm, z_mm"),
    choice("rail_profile", "uic60", (), "uic60, or a CSV file of y_mm, z_mm"),
    number("profile_smoothing_m", 0.001, 0.0, 0.01, "moving mean over slopes of profiles from files"),
)
