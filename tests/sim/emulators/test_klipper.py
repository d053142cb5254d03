"""The emulated Klipper refuses what Klipper refuses, in its words."""

import pytest

from sim.emulators.klipper import KlipperEmulator, KlipperError


def run(printer: KlipperEmulator, script: str) -> None:
    assert printer.answer("POST", "/printer/gcode/script", {"script": script}) == "ok"


@pytest.mark.parametrize(
    ("script", "text"),
    [
        ("G1 X10 F600", "Must home axis first: 10.000 0.000 0.000 [0.000]"),
        ("G28 X\nG1 X200.5", "Move out of range: 200.500 0.000 0.000 [0.000]"),
        ("G28 X\nG1 X10 F0", "Invalid speed in 'G1 X10 F0'"),
        ("SET_PIN VALUE=1", "Error on 'SET_PIN VALUE=1': missing PIN"),
        ("SET_PIN PIN=LASER VALUE=1", "The value 'LASER' is not valid for PIN. Options: laser"),
        ("SET_PIN PIN=laser", "SET_PIN command must specify VALUE or TEMPLATE"),
        ("SET_PIN PIN=laser VALUE=2", "Error on '.*': VALUE must have maximum of 1.0"),
        ("SET_PIN PIN=laser VALUE=0.5", "Invalid pin value"),
    ],
)
def test_a_command_that_cannot_be_carried_out(script: str, text: str) -> None:
    pattern = text if ".*" in text else text.replace("[", r"\[").replace("]", r"\]")
    with pytest.raises(KlipperError, match=pattern) as caught:
        run(KlipperEmulator(), script)
    assert caught.value.status == 400


def test_a_move_takes_its_time_and_m400_waits_for_it() -> None:
    now_s = [0.0]
    printer = KlipperEmulator(clock=lambda: now_s[0])
    run(printer, "G28 X\nG1 X30 F600")
    now_s[0] = 1.0
    toolhead = printer.answer("POST", "/printer/objects/query", {"objects": {"toolhead": None}})
    assert toolhead["status"]["toolhead"]["position"][0] == 30.0
    assert printer.head_mm[0] == pytest.approx(10.0)
    now_s[0] = 3.0
    run(printer, "M400")
    assert printer.head_mm[0] == 30.0


def test_a_restart_forgets_homing_and_where_the_head_stands() -> None:
    printer = KlipperEmulator(clock=lambda: 0.0, pace=1e9)
    run(printer, "G28 X\nG1 X30 F600")
    printer._begun = (-1.0, *printer._begun[1:])
    run(printer, "FIRMWARE_RESTART")
    assert (printer.head_mm[0], printer.homed) == (pytest.approx(30.0), set())
    with pytest.raises(KlipperError, match="Must home axis first"):
        run(printer, "G1 X1")


def test_what_is_not_there_is_left_out_or_refused() -> None:
    printer = KlipperEmulator()
    asked = {"objects": {"output_pin beam": None, "toolhead": ["homed_axes", "colour"]}}
    status = printer.answer("POST", "/printer/objects/query", asked)["status"]
    assert status == {"toolhead": {"homed_axes": ""}}
    for method, path, body, code in (
        ("GET", "/printer/gcode", None, 404),
        ("GET", "/printer/gcode/script", None, 405),
        ("POST", "/printer/gcode/script", {}, 400),
    ):
        with pytest.raises(KlipperError) as caught:
            printer.answer(method, path, body)
        assert caught.value.status == code
