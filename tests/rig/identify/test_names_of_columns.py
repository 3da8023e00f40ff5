"""Columns of loggers are recognised by their names, and a proposal says what is missing."""

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.files import proposal, stamps, units, words

N = 40


def content(name: str, unit: str = "", step: float = 0.1, first: float = 0.0) -> proposal.Content:
    """Return a column with increasing numbers."""
    unit = unit or units.split(name).unit
    return proposal.Content(name, unit, first + step * np.arange(N), is_stamp=False)


def proposed(*names: str, **options: dict[str, str] | int) -> proposal.Proposal:
    return proposal.propose([content(name) for name in names], **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "quantity", "number"),
    [
        ("Zeit [s]", "time", 0),
        ("Time (sec)", "time", 0),
        ("Zeitstempel", "time", 0),
        ("Uhrzeit", "time", 0),
        ("t", "time", 0),
        ("timestamp_ms", "time", 0),
        ("v_Fzg [km/h]", "vehicle_speed", 0),
        ("Geschwindigkeit [km/h]", "vehicle_speed", 0),
        ("Fahrzeuggeschwindigkeit / km/h", "vehicle_speed", 0),
        ("Vehicle speed (km/h)", "vehicle_speed", 0),
        ("Car.v", "vehicle_speed", 0),
        ("n_Rad1 [1/min]", "wheel_speed", 1),
        ("Drehzahl Radsatz 3 [U/min]", "wheel_speed", 3),
        ("Achsgeschwindigkeit 2 [km/h]", "wheel_speed", 2),
        ("v_Achse_4 [km/h]", "wheel_speed", 4),
        ("wheel speed FL (m/s)", "wheel_speed", 1),
        ("wheel speed front right (m/s)", "wheel_speed", 2),
        ("Radgeschwindigkeit hinten links [km/h]", "wheel_speed", 3),
        ("WheelSpd_RR [rad/s]", "wheel_speed", 4),
        ("Vhcl.FL.rotv [rad/s]", "wheel_speed", 1),
        ("wheel_fl_m_s", "wheel_speed", 1),
        ("v2", "wheel_speed", 2),
        ("n3 [1/min]", "wheel_speed", 3),
        ("axle_1", "wheel_speed", 1),
        ("v_Drehgestell2 [km/h]", "bogie_speed", 2),
        ("bogie_speed_1_m_s", "bogie_speed", 1),
        ("GPS speed", "reference_speed", 0),
        ("gps", "reference_speed", 0),
        ("gnss_speed_m_s", "reference_speed", 0),
        ("v_Radar [km/h]", "reference_speed", 0),
        ("Bremszylinderdruck 1 [bar]", "cylinder_pressure", 1),
        ("Bremsanforderung", "brake_demand", 0),
        ("brake", "brake_demand", 0),
        ("Achslast 2 [kN]", "wheel_load", 2),
        ("Bremsmoment 4 [kNm]", "brake_torque", 4),
        ("brake_torque_1_Nm", "brake_torque", 1),
        ("Weg [m]", "position", 0),
        ("position_m", "position", 0),
        ("Schlupf [%]", "creepage", 0),
        ("Kraftschluss [-]", "adhesion", 0),
        ("traction coeff [%]", "adhesion", 0),
        ("Q1 [kN]", "wheel_load", 1),
        ("M1 [kNm]", "brake_torque", 1),
        ("M2 [lbf ft]", "brake_torque", 2),
        ("VrTCU_A1_Velocity", "wheel_speed", 2),
        ("MILES", "position", 0),
        ("Date", "date", 0),
    ],
)
def test_a_column_is_recognised_by_its_name(name: str, quantity: str, number: int) -> None:
    found = words.meaning(words.column(name, units.split(name).unit))
    assert found == words.Meaning(quantity, number)


@pytest.mark.parametrize(
    "name",
    [
        "Engine RPM (RPM)",
        "v_soll [km/h]",
        "Motordrehzahl [1/min]",
        "Temperatur 1 [°C]",
        "roller_speed_1_rad_s",
        "sliding_1_m_s",
        "steering_deg",
        "Umgebungsdruck [hPa]",
        "Geschwindigkeit [bar]",
        "Speed limit (km/h)",
        "vehicle_acceleration_m_s2",
        "a_1",
        "Radlast 1 [km/h]",
        "foo",
    ],
)
def test_a_column_of_something_else_is_not_recognised(name: str) -> None:
    assert words.meaning(words.column(name, units.split(name).unit)) is None


def columns_of(found: proposal.Proposal) -> dict[str, tuple[str, str]]:
    return {channel.key: (channel.column, channel.unit) for channel in found.channels}


def test_a_german_recorder_is_proposed() -> None:
    found = proposed("Zeit [s]", "v_GPS [km/h]", "n_Rad1 [1/min]", "n_Rad2 [1/min]", "Status")
    assert found.kind == "recorder"
    assert columns_of(found) == {
        "time_s": ("Zeit [s]", "s"),
        "reference_speed_m_s": ("v_GPS [km/h]", "km/h"),
        "wheel_speed_1_m_s": ("n_Rad1 [1/min]", "1/min"),
        "wheel_speed_2_m_s": ("n_Rad2 [1/min]", "1/min"),
    }
    assert [unused.column for unused in found.unused] == ["Status"]
    assert any("radius of the wheels" in remark for remark in found.remarks)


def test_an_export_of_comma2k19_is_proposed() -> None:
    wheels = [f"wheel_{corner}_m_s" for corner in ("fl", "fr", "rl", "rr")]
    found = proposed("time_s", *wheels, "gnss_speed_m_s", "pose_speed_m_s", "steering_deg")
    columns = columns_of(found)
    assert columns["reference_speed_m_s"] == ("gnss_speed_m_s", "m/s")
    for axle, name in enumerate(wheels, start=1):
        assert columns[f"wheel_speed_{axle}_m_s"] == (name, "m/s")
    assert {unused.column for unused in found.unused} == {"pose_speed_m_s", "steering_deg"}


def test_the_speed_of_an_obd_log_is_that_of_a_wheel_and_the_receiver_is_the_reference() -> None:
    found = proposed(
        "Time (sec)", "Vehicle speed (km/h)", "Engine RPM (RPM)", "GPS Speed (km/h)", "Altitude (m)"
    )
    assert columns_of(found) == {
        "time_s": ("Time (sec)", "s"),
        "reference_speed_m_s": ("GPS Speed (km/h)", "km/h"),
        "wheel_speed_1_m_s": ("Vehicle speed (km/h)", "km/h"),
    }
    assert any("taken as the speed of a wheel" in remark for remark in found.remarks)


def test_a_speed_of_the_vehicle_beside_wheels_is_the_reference_with_a_remark() -> None:
    corners = [content(f"Vhcl.{corner}.rotv", "rad/s") for corner in ("FL", "FR", "RL", "RR")]
    found = proposal.propose([content("Time", "s"), content("Car.v", "m/s"), *corners])
    assert columns_of(found)["reference_speed_m_s"] == ("Car.v", "m/s")
    assert columns_of(found)["wheel_speed_4_m_s"] == ("Vhcl.RR.rotv", "rad/s")
    assert any("without the wheels" in remark for remark in found.remarks)


def braking(without: str = "", axles: int = 4) -> list[str]:
    names = ["Zeit [ms]", "Fahrzeuggeschwindigkeit [km/h]"]
    for axle in range(1, axles + 1):
        names += [
            f"Drehzahl Radsatz {axle} [1/min]",
            f"Achslast {axle} [kN]",
            f"Bremsmoment {axle} [kNm]",
        ]
    return [name for name in names if name != without]


def test_loads_and_torques_of_four_wheelsets_make_braking_runs() -> None:
    found = proposed(*braking())
    assert found.kind == "braking_runs"
    assert columns_of(found)["wheel_speed_3_rad_s"] == ("Drehzahl Radsatz 3 [1/min]", "1/min")
    assert columns_of(found)["brake_torque_2_Nm"] == ("Bremsmoment 2 [kNm]", "kNm")
    assert len(found.channels) == 14
    assert proposed(*braking(without="Achslast 2 [kN]")).kind == "recorder"


def test_braking_runs_have_the_channels_of_all_wheelsets_of_the_vehicle() -> None:
    found = proposed(*braking(axles=8), axles=8)
    assert found.kind == "braking_runs"
    assert columns_of(found)["wheel_load_8_N"] == ("Achslast 8 [kN]", "kN")
    assert len(found.channels) == 26
    assert proposed(*braking(axles=6), axles=8).kind == "recorder"


def test_creepage_and_adhesion_make_a_creep_curve() -> None:
    found = proposed("Schlupf [%]", "Kraftschluss [-]", "Geschwindigkeit [m/s]")
    assert found.kind == "creep_curve"
    assert columns_of(found)["creepage"] == ("Schlupf [%]", "%")


def test_a_speed_without_a_unit_is_never_given_one() -> None:
    found = proposed("t", "v1", "v2")
    assert found.without_unit() == ["wheel_speed_1_m_s", "wheel_speed_2_m_s"]
    given = proposed("t", "v1", "v2", given_units={"wheel": "km/h"})
    assert given.without_unit() == []
    assert columns_of(given)["wheel_speed_2_m_s"] == ("v2", "km/h")


@pytest.mark.parametrize(
    ("first", "step", "unit"),
    [
        (0.0, 0.1, "s"),
        (0.0, 100.0, "ms"),
        (1774778400.0, 0.1, "s"),
        (1774778400e3, 100.0, "ms"),
        (1774778400e6, 1e5, "us"),
        (1774778400e9, 1e8, "ns"),
        (46082.4, 1e-6, ""),  # days of a spreadsheet
    ],
)
def test_the_unit_of_stamps_is_proposed_from_their_size(
    first: float, step: float, unit: str
) -> None:
    columns = [content("stamp", step=step, first=first), content("v1 [km/h]")]
    assert columns_of(proposal.propose(columns))["time_s"] == ("stamp", unit)


def test_a_given_column_replaces_the_proposed_one_and_an_empty_one_leaves_the_channel_out() -> None:
    names = ("t", "v1 [km/h]", "v2 [km/h]", "gps [km/h]")
    found = proposed(*names, mapped={"wheel_speed_1_m_s": "v2 [km/h]", "reference_speed_m_s": ""})
    assert columns_of(found) == {
        "time_s": ("t", "s"),
        "wheel_speed_1_m_s": ("v2 [km/h]", "km/h"),
    }


def test_a_given_column_that_does_not_exist_is_refused_with_the_similar_one() -> None:
    with pytest.raises(ConfigError, match=r"no column 'v_1'.*v1 \[km/h\]"):
        proposed("t", "v1 [km/h]", mapped={"wheel_speed_1_m_s": "v_1"})


def test_a_given_column_may_be_named_without_its_unit() -> None:
    found = proposed("t", "x [km/h]", "y [km/h]", mapped={"wheel_speed_1_m_s": "y"})
    assert columns_of(found)["wheel_speed_1_m_s"] == ("y [km/h]", "km/h")


def test_a_given_column_that_differs_from_another_in_its_unit_only_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"differ only in their unit.*write one with its unit"):
        proposed("t", "v [km/h]", "v [m/s]", mapped={"wheel_speed_1_m_s": "v"})


def test_speeds_whose_names_differ_in_a_letter_are_two_wheels() -> None:
    """The names of a tram's logger: TRDP, a train network, and the control units A and B."""
    found = proposed(
        "t", "TRDP.TCU.VrTCU_A_A1_Velocity", "TRDP.TCU.VrTCU_B_A1_Velocity", "TRDP.TotalDistance"
    )
    columns = columns_of(found)
    assert columns["wheel_speed_1_m_s"][0] == "TRDP.TCU.VrTCU_A_A1_Velocity"
    assert columns["wheel_speed_2_m_s"][0] == "TRDP.TCU.VrTCU_B_A1_Velocity"
    assert any("numbered in the order of the file" in remark for remark in found.remarks)


def test_speeds_with_other_words_and_one_number_stay_one_wheel() -> None:
    found = proposed("t", "v1 filtered [km/h]", "v1 raw [km/h]")
    assert [key for key in columns_of(found) if "speed" in key] == ["wheel_speed_1_m_s"]


def test_what_braking_runs_lack_is_listed() -> None:
    wheels = [f"n_Rad{axle} [1/min]" for axle in (1, 2, 3, 4)]
    loads = [f"Q{axle} [kN]" for axle in (1, 2, 3)]
    torques = [f"M{axle} [kNm]" for axle in (1, 2, 3, 4)]
    found = proposed("t", "v_Fzg [km/h]", *wheels, *loads, *torques)
    assert found.kind == "recorder"
    [remark] = [one for one in found.remarks if "missing" in one]
    assert "wheel_load_4_N" in remark
    assert "wheel_load_3_N" not in remark
    assert (
        proposed("t", "v_Fzg [km/h]", *wheels, *loads, "Q4 [kN]", *torques).kind == "braking_runs"
    )


def test_a_column_of_dates_beside_times_is_the_date() -> None:
    dates = proposal.Content("Date", "", np.full(N, np.nan), is_stamp=False)
    times = proposal.Content("Time", "", np.full(N, np.nan), is_stamp=True)
    found = proposal.propose([dates, times, content("v1 [km/h]")])
    assert columns_of(found)["time_s"][0] == "Time"
    assert [(one.column, one.reason) for one in found.unused] == [
        ("Date", "its first date is the date of the run")
    ]


@pytest.mark.parametrize(
    ("text", "date"),
    [
        ("2026-03-01", "2026-03-01"),
        ("20.04.2022", "2022-04-20"),
        ("20/04/2022", "2022-04-20"),
        ("04/20/2022", "2022-04-20"),
        ("04/05/2022", ""),
        ("10:00", ""),
    ],
)
def test_a_date_is_read_unless_day_and_month_are_unclear(text: str, date: str) -> None:
    assert stamps.date_of(text) == date


def test_a_file_in_which_nothing_is_recognised_is_refused_with_the_option() -> None:
    with pytest.raises(ConfigError, match=r"no column is recognised.*--map"):
        proposed("foo", "bar")
    found = proposed("foo", "bar", mapped={"time_s": "foo", "wheel_speed_1_m_s": "bar"})
    assert found.kind == "recorder"


def test_braking_runs_are_found_by_units_and_numbers_alone() -> None:
    names = ["t [s]", "A [km/h]"]
    for number in range(1, 5):
        names += [f"B{number} [1/min]", f"C{number} [kN]", f"D{number} [kNm]"]
    found = proposed(*names)
    assert found.kind == "braking_runs"
    columns = {channel.key: channel.column for channel in found.channels}
    assert columns["wheel_load_3_N"] == "C3 [kN]"
    assert columns["brake_torque_4_Nm"] == "D4 [kNm]"
    assert "by their units and numbers only" in " ".join(found.remarks)


def test_forces_that_are_not_numbered_by_wheelset_are_no_loads() -> None:
    names = ["t [s]", "A [km/h]"]
    names += [f"B{number} [1/min]" for number in range(1, 5)]
    names += [f"C{number} [kN]" for number in range(2, 6)]
    found = proposed(*names)
    assert found.kind == "recorder"
    assert not any(channel.column.startswith("C") for channel in found.channels)


def test_two_speeds_of_a_vehicle_that_differ_in_a_letter_are_two_wheels() -> None:
    found = proposed("t", "TCU_A_Velocity [km/h]", "TCU_B_Velocity [km/h]")
    columns = {channel.key: channel.column for channel in found.channels}
    assert columns["wheel_speed_1_m_s"] == "TCU_A_Velocity [km/h]"
    assert columns["wheel_speed_2_m_s"] == "TCU_B_Velocity [km/h]"


def test_letters_of_formulas_make_a_creep_curve() -> None:
    found = proposed("s [%]", "mu [-]")
    assert found.kind == "creep_curve"
