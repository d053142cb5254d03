"""What Grbl 1.1's numbers mean, in words: error:N and ALARM:N.

Sources: the tables "Error Code Description" and "Alarm Code Description" of the Grbl 1.1
interface documentation, reworded for someone who stands before a linear track.
"""

ERRORS = {
    1: "a word of the line does not begin with a letter",
    2: "a number is missing or cannot be read",
    3: "the controller does not know this $ command",
    4: "a value is negative where only a positive one makes sense",
    5: "homing is switched off in the controller ($22=0)",
    6: "the step pulse must be longer than 3 µs ($0)",
    7: "the stored settings could not be read and were set back to their defaults",
    8: "this $ command is taken only while the machine is idle",
    9: "commands are locked out while the machine is in alarm or jogging",
    10: "soft limits ($20) need homing ($22) to be on",
    11: "the line is too long and was ignored",
    12: "the setting asks for more steps a second than the controller can make",
    13: "the safety door is open",
    14: "the start-up line is too long to be stored",
    15: "the target lies beyond the machine's travel; nothing moved",
    16: "a jog command lacks its '=' or holds a code that a jog may not",
    17: "laser mode needs a controller with PWM output",
    20: "the code is unknown or not supported",
    21: "two codes of one modal group stand in the same line",
    22: "no feed rate has been set",
    23: "a code needs a whole number",
    24: "two codes of the line both claim the axis words",
    25: "a word stands twice in the line",
    26: "the code needs an axis word and there is none",
    27: "the line number is out of range",
    28: "a P or L word is missing",
    29: "only the coordinate systems G54 to G59 exist",
    30: "G53 works with G0 and G1 only",
    31: "axis words stand in a line that has no use for them",
    32: "an arc has no axis word in its plane",
    33: "the target of the motion is invalid",
    34: "the arc cannot be computed from its radius",
    35: "an arc has no offset word in its plane",
    36: "a word of the line has no use there",
    37: "the tool length offset is set for another axis",
    38: "the tool number is too high",
}

ALARMS = {
    1: "a limit switch was hit; the position is lost",
    2: "the target lies beyond the machine's travel; the position is kept",
    3: "reset while moving; the position is lost",
    4: "the probe was not in its expected state before probing",
    5: "the probe met nothing",
    6: "homing was cut off by a reset",
    7: "the safety door was opened while homing",
    8: "homing could not pull off the limit switch; raise $27 or check the wiring",
    9: "homing found no limit switch within the travel; check the switch, $23 and $130 to $132",
}


def error_in_words(code: int) -> str:
    """``error:N, meaning`` of a Grbl error code; of an unknown one, that it is unknown."""
    return f"error:{code}, {ERRORS.get(code, 'which Grbl 1.1 does not document')}"


def alarm_in_words(code: int) -> str:
    """``ALARM:N, meaning`` of a Grbl alarm code; of an unknown one, that it is unknown."""
    return f"ALARM:{code}, {ALARMS.get(code, 'which Grbl 1.1 does not document')}"
