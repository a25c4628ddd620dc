"""Infers the wiring of the wheels from what each letter turned."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from acsar_gym.config import RobotConfig, WheelConfig, WheelsConfig
from acsar_gym.doctor import ratios
from acsar_gym.doctor.checks import Check
from acsar_gym.doctor.spinning import Answer
from acsar_gym.errors import ConfigError, shown
from acsar_gym.protocol import MOTORS, WHEELS

Seen = tuple[int, int] | None
"""Which wheel was seen to turn, and 1 for forward, -1 for backward; None if none turned."""
MIRRORED = (1, 0, 3, 2)
"""Indices of the wheels on the other side."""
WATCH = "watch: a turns front right, b front left, c rear left, d rear right, forward"
AS_FILE = "as the robot's file says"
UNLESS = " (or its motor, if the wheel turned backward)"


def seen(answer: str, letter: int) -> Seen:
    """Read what somebody saw while one letter was commanded forward.

    Args:
        answer: letter of the wheel that turned, with n for backward (or p for forward) behind it;
            "none" if none turned; empty for the letter's own wheel.
        letter: index of the commanded letter.

    Raises:
        ConfigError: it says none of these.
    """
    said = answer.strip().lower()
    if said in ("none", "0"):
        return None
    said = said or MOTORS[letter]
    if said[0] in MOTORS and said[1:] in ("", "p", "n"):
        return MOTORS.index(said[0]), -1 if said[1:] == "n" else 1
    raise ConfigError(
        f"{shown(answer)}: write the wheel that turned (a front right, b front left, c rear left, "
        "d rear right), an n behind it if it turned backward, or none"
    )


def eyes_of(said: Sequence[str]) -> list[Seen]:
    """Read what was seen for a, b, c, d; ConfigError where it can't be. See `seen`."""
    if len(said) != len(MOTORS):
        raise ConfigError(
            f"--saw {' '.join(said)}: must be four, the wheels that turned for a, b, c and d, such "
            "as b a d c; DEVICE stands before the options"
        )
    eyes = [seen(answer, letter) for letter, answer in enumerate(said)]
    wheels = [saw[0] for saw in eyes if saw is not None]
    if len(set(wheels)) < len(wheels):
        raise ConfigError(f"{' '.join(said)}: one wheel turned for two letters: look again")
    return eyes


def wiring(
    answers: Sequence[Answer], eyes: Sequence[Seen] | None, config: RobotConfig
) -> WheelsConfig:
    """Infer the wiring; wheels of which nothing is known keep their letters, or those left.

    Args:
        answers: of the encoders, for the letters a, b, c, d.
        eyes: what was seen to turn, for each; None if nobody looked: motors are then taken to be
            where the robot's file says.
        config: of the robot, as its file says.
    """
    own = [(MOTORS.index(wheel.motor), wheel.motor_sign) for wheel in config.wheels.each]
    letters = [letter for letter, _ in own]
    motors: dict[int, tuple[int, int]] = {}
    encoders: dict[int, tuple[int, int]] = {}
    for answer in answers:
        wheel = letters.index(answer.letter)
        saw = (wheel, own[wheel][1]) if eyes is None else eyes[answer.letter]
        if saw is None:
            continue
        wheel, way = saw
        motors[wheel] = answer.letter, way
        if answer.encoder is not None and answer.encoder not in {e for e, _ in encoders.values()}:
            sign = answer.sign * way if answer.is_right else config.wheels.each[wheel].sign
            encoders[wheel] = answer.encoder, sign
    heard = [(MOTORS.index(wheel.encoder), wheel.sign) for wheel in config.wheels.each]
    return _config(_filled(motors, own), _filled(encoders, heard))


def _filled(
    known: dict[int, tuple[int, int]], own: Sequence[tuple[int, int]]
) -> dict[int, tuple[int, int]]:
    """Give the other wheels their own letters and signs, or letters that are left."""
    left = set(range(4)) - {letter for letter, _ in known.values()}
    filled = dict(known)
    others = [wheel for wheel in range(4) if wheel not in known]
    for wheel in sorted(others, key=lambda wheel: own[wheel][0] not in left):
        filled[wheel] = own[wheel] if own[wheel][0] in left else (min(left), 1)
        left.discard(filled[wheel][0])
    return filled


def _config(
    motors: dict[int, tuple[int, int]], encoders: dict[int, tuple[int, int]]
) -> WheelsConfig:
    fields: dict[str, Any] = {
        letter: {
            "motor": MOTORS[motors[wheel][0]],
            "motor_sign": motors[wheel][1],
            "encoder": MOTORS[encoders[wheel][0]],
            "sign": encoders[wheel][1],
        }
        for wheel, letter in enumerate(MOTORS)
    }
    return WheelsConfig(**fields)


def checks(
    answers: Sequence[Answer], eyes: Sequence[Seen] | None, config: RobotConfig, found: WheelsConfig
) -> Iterator[Check]:
    """Say what was found about each wheel, and about all of them.

    Args:
        answers: of the encoders, for the letters a, b, c, d.
        eyes: what was seen to turn; None if nobody looked.
        config: as it was configured.
        found: the wiring that was inferred.
    """
    for wheel, name in enumerate(WHEELS):
        yield _wheel(wheel, name, answers, eyes, config, found.each[wheel])
    yield _sides(answers, eyes, config, found)


def _wheel(
    wheel: int,
    name: str,
    answers: Sequence[Answer],
    eyes: Sequence[Seen] | None,
    config: RobotConfig,
    found: WheelConfig,
) -> Check:
    """Say what was found about one wheel."""
    answer = answers[MOTORS.index(found.motor)]
    heard = MOTORS[answer.encoder] if answer.encoder is not None else None
    if heard is None or heard != found.encoder:
        return _dead(wheel, name, answer, eyes)
    way = "forward" if found.sign == 1 else "backward"
    turns = f"motor {found.motor}" + (" reversed" if found.motor_sign == -1 else "")
    text = f"{turns}, encoder {heard} counts {way}, measured/commanded {abs(answer.ratio):.2f}"
    if len(answer.moving) > 1:
        others = ", ".join(MOTORS[k] for k in answer.moving[1:])
        return Check(name, "fail", f"{text}; encoder {others} turns with it", "check its wires")
    if not answer.is_right:
        text = f"{turns}, encoder {heard}: {ratios.describe(answer)}"
        return Check(name, "fail", text, ratios.explain(answer, answers, config))
    if found == config.wheels.each[wheel]:
        return Check(name, "ok", text)
    return Check(
        name,
        "warn",
        f"{text}: {_different(found, wheel, config.wheels, looked=eyes is not None)}",
        _mapping(wheel, found),
    )


def _different(found: WheelConfig, wheel: int, file: WheelsConfig, *, looked: bool) -> str:
    """Say how a wheel's wiring differs from that in the robot's file, or from its letter's."""
    own, parts = file.each[wheel], []
    if found.motor != own.motor:
        parts.append("its motor has another letter")
    if found.motor_sign != own.motor_sign:
        parts.append("its motor is reversed")
    if found.encoder != own.encoder:
        other = [one.encoder for one in file.each].index(found.encoder)
        parts.append(f"its encoder is swapped with that of {WHEELS[other]}")
    if found.sign != own.sign:
        parts.append("its encoder is reversed" + ("" if looked else UNLESS))
    return " and ".join(parts) + _unlike(file)


def _unlike(file: WheelsConfig) -> str:
    """Say that a wiring differs from that in the robot's file, if it has one."""
    return "" if file == WheelsConfig() else ", unlike in the robot's file"


def _mapping(wheel: int, found: WheelConfig) -> str:
    """Return the YAML that maps a wheel."""
    usual = WheelConfig(motor=MOTORS[wheel], encoder=MOTORS[wheel])
    fields = {
        name: getattr(found, name)
        for name in WheelConfig.model_fields
        if getattr(found, name) != getattr(usual, name)
    }
    inner = ", ".join(f"{name}: {value}" for name, value in fields.items())
    return f"swap the wires, or use wheels: {{{MOTORS[wheel]}: {{{inner}}}}}"


def _dead(wheel: int, name: str, answer: Answer, eyes: Sequence[Seen] | None) -> Check:
    """Say that a wheel or its encoder is dead."""
    letter = MOTORS[answer.letter]
    if answer.encoder is not None:
        other = MOTORS[answer.encoder]
        return Check(
            name, "fail", f"encoder {other} answers to motor {letter}, too", "check its wires"
        )
    found = f"dead: no encoder answers to motor {letter}"
    if eyes is None:
        return Check(
            name,
            "fail",
            f"{found}; the wire can't tell whether the motor or the encoder is dead",
            f"look whether {name} turns: if it does, check its encoder, otherwise its motor",
        )
    if any(saw is not None and saw[0] == wheel for saw in eyes):
        return Check(name, "fail", f"{found}: its encoder is dead", "check the encoder's plug")
    return Check(name, "fail", f"{found}: its motor is dead", "check the motor's plug and driver")


def assumed(config: RobotConfig, found: WheelsConfig, eyes: Sequence[Seen] | None) -> bool:
    """Whether a wiring was found that the wire alone can't tell from another one."""
    return eyes is None and found != config.wheels


def _sides(
    answers: Sequence[Answer],
    eyes: Sequence[Seen] | None,
    config: RobotConfig,
    found: WheelsConfig,
) -> Check:
    """Say whether the sides are swapped, and what only eyes can tell."""
    same = found == config.wheels
    if eyes is not None:
        return _seen(_as_seen(answers, eyes), config.wheels, same=same)
    own = config.wheels.each
    heard = [wheel for wheel in range(4) if _answered(answers, found.each[wheel])]
    if heard and all(found.each[w].encoder == own[MIRRORED[w]].encoder for w in heard):
        return Check(
            "wiring",
            "warn",
            "left and right are swapped, of the encoders or of the motors: that it is the encoders "
            "is an assumption, and the robot turns the wrong way where it isn't so",
            f"{WATCH}; where a turned front left, say --saw b a d c",
        )
    if not same:
        return Check(
            "wiring",
            "warn",
            "that encoders are swapped or reversed, and not motors, is an assumption",
            f"{WATCH}; otherwise say what turned, such as --saw b a d c",
        )
    if config.wheels != WheelsConfig():
        return Check("wiring", "ok", AS_FILE)
    return Check(
        "wiring",
        "ok",
        "only eyes see a motor and an encoder that are swapped or reversed together",
        f"{WATCH}; otherwise say what turned, such as --saw b a d c",
    )


def _seen(text: str, file: WheelsConfig, *, same: bool) -> Check:
    """Say whether what was seen is what the robot's file says, and that it counts."""
    if not same:
        fix = "what was seen counts: write it into a robot's file with --out FILE"
        return Check("wiring", "warn", f"{text}{_unlike(file)}", fix)
    return Check("wiring", "ok", text if file == WheelsConfig() else f"{text}, {AS_FILE}")


def _answered(answers: Sequence[Answer], found: WheelConfig) -> bool:
    """Whether an encoder answered to a wheel's motor."""
    return answers[MOTORS.index(found.motor)].encoder is not None


def _as_seen(answers: Sequence[Answer], eyes: Sequence[Seen]) -> str:
    """Say which sides are swapped where somebody looked."""
    heard = [answer for answer in answers if answer.encoder is not None]
    crossed = bool(heard) and all(each.encoder == MIRRORED[each.letter] for each in heard)
    saw = [(letter, each[0]) for letter, each in enumerate(eyes) if each is not None]
    mirrored = bool(saw) and all(wheel == MIRRORED[letter] for letter, wheel in saw)
    swapped = [w for w, so in (("motors", mirrored), ("encoders", crossed != mirrored)) if so]
    return f"left and right {' and '.join(swapped)} are swapped" if swapped else "as seen"
