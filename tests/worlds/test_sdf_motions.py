"""What moves in Gazebo: actors' scripts, and key frames in the sources of plugins."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
from gazebo_texts import body, include, model, moving, pose, sdf_of, write_model

from acsar_gym.errors import AcsarWarning, WorldError
from acsar_gym.worlds import files, sdf_motions
from acsar_gym.worlds.movers import Mover, Repeat
from acsar_gym.worlds.world import World

ENDS = files.Placement(start=(0.0, 0.0, 0.0), goal=(3.0, 0.0))
WAY = [(0.0, 1.0, 2.0), (2.0, 3.0, 2.0), (4.0, 3.0, 5.0)]
OBSTACLE = '<plugin name="obs_3" filename="libobs_3.so"/>'
PILLAR = "<cylinder><radius>0.5</radius><length>1</length></cylinder>"


def trajectory(way: list[tuple[float, float, float]], attributes: str = "") -> str:
    waypoints = "".join(
        f"<waypoint><time>{time}</time>{pose(x, y, 1, 0, 0, 0)}</waypoint>" for time, x, y in way
    )
    return f"<trajectory id='0' type='walk' {attributes}>{waypoints}</trajectory>"


def actor(*parts: str, name: str = "person") -> str:
    return f"<actor name='{name}'>{pose(9, 9, 0, 0, 0, 0)}<script>{''.join(parts)}</script></actor>"


def load(folder: Path, *parts: str) -> World:
    """Read a world, whose parts all move."""
    (folder / "hall.world").write_bytes(sdf_of(*parts))
    with warnings.catch_warnings():
        warnings.simplefilter("error", AcsarWarning)
        return files.load_world(folder / "hall.world", ENDS)


def load_one(folder: Path, *parts: str) -> Mover:
    (mover,) = load(folder, *parts).movers
    return mover


def test_an_actor_follows_its_waypoints(tmp_path: Path) -> None:
    mover = load_one(tmp_path, actor(trajectory(WAY)))
    for time, x, y in WAY[:-1]:
        assert mover.position(time) == pytest.approx((x, y))
        assert mover.position(time + 4.0) == pytest.approx((x, y))
    assert mover.position(4.0 - 1e-9) == pytest.approx((3.0, 5.0))
    assert (mover.name, mover.radius, mover.repeat) == ("person", 0.25, Repeat.LOOP)
    straight = load_one(tmp_path, actor(trajectory(WAY, "tension='1'")))
    assert straight.position(1.0) == pytest.approx((2.0, 2.0))
    assert straight.velocity(2.0) == pytest.approx((0.0, 0.0))
    assert mover.velocity(2.0) == pytest.approx((0.5, 0.75))


def test_an_actor_waits_stops_and_goes_on(tmp_path: Path) -> None:
    mover = load_one(tmp_path, actor("<loop>false</loop>", trajectory(WAY)))
    assert mover.position(99.0) == (3.0, 5.0)
    delay = "<delay_start>3</delay_start>"
    mover = load_one(tmp_path, actor(delay, trajectory(WAY)))
    assert mover.position(2.9) == (1.0, 2.0)
    assert mover.position(5.0) == pytest.approx((3.0, 2.0))
    assert mover.position(7.0 + 2.9) == (1.0, 2.0)  # each time it begins anew
    then = trajectory([(6.0, 3.0, 5.0), (8.0, 1.0, 2.0)])
    mover = load_one(tmp_path, actor(then, trajectory(WAY)))
    assert mover.position(5.0) == (3.0, 5.0)
    assert mover.duration == 8.0
    mover = load_one(tmp_path, actor("<auto_start>false</auto_start>", trajectory(WAY)))
    assert mover.position(3.0) == (1.0, 2.0)
    assert load_one(tmp_path, actor(trajectory(WAY[:1]))).position(3.0) == (1.0, 2.0)


def test_an_included_actor_has_the_includes_name(tmp_path: Path) -> None:
    write_model(tmp_path, "walker", actor(trajectory(WAY), name="inner"))
    mover = load_one(tmp_path, include("model://walker", "<name>nurse</name>"))
    assert mover.name == "nurse"
    assert mover.position(0.0) == (1.0, 2.0)


@pytest.mark.parametrize(
    ("parts", "problem"),
    [
        ([trajectory([(0, 0, 0), (0.1, 9, 0)])], "moves at"),
        ([trajectory([(1, 0, 0), (1, 9, 0)])], "growing"),
        ([trajectory([(-1, 0, 0), (1, 1, 0)])], "time must not be negative, is -1"),
        ([trajectory(WAY).replace("1.0", "one")], "pose of a waypoint must be 6 finite numbers"),
        ([trajectory(WAY).replace("1.0", "nan")], "pose of a waypoint must be 6 finite numbers"),
        ([trajectory(WAY), trajectory(WAY)], "its trajectories overlap in time"),
        ([trajectory(WAY, "tension='much'")], "the tension of a trajectory must be a number"),
        (["<delay_start>soon</delay_start>", trajectory(WAY)], "delay_start must be 1 finite"),
    ],
)
def test_bad_scripts_are_one_line(parts: list[str], problem: str, tmp_path: Path) -> None:
    with pytest.raises(WorldError, match=r"hall\.world: .*person") as caught:
        load(tmp_path, actor(*parts))
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)


def source(keys: list[tuple[float, float, float]], length: float, loops: str = "true") -> str:
    """C++ source of a plugin as DynaBARN's generator writes it."""
    frames = "".join(
        f"""
        key = anim->CreateKeyFrame({time:.2f});
        key->Translation(ignition::math::Vector3d({x:.2f}, {y:.2f}, 0));
        key->Rotation(ignition::math::Quaterniond(0, 0, 0));
        """
        for time, x, y in keys
    )
    return f"""
    // key = anim->CreateKeyFrame(7.0);
    gazebo::common::PoseAnimationPtr anim(
              // name the animation 'obs_3',
              new gazebo::common::PoseAnimation("obs_3", {length:.2f}, {loops}));
    gazebo::common::PoseKeyFrame *key; {frames}
    _parent->SetAnimation(anim);"""


KEYS = [(0.0, -10.0, 4.0), (5.0, -5.0, 3.0), (10.0, 0.0, -1.0)]
CYLINDER = moving(OBSTACLE, "obs").replace("<radius>0.1", "<radius>0.5")


@pytest.mark.parametrize("place", [".", "plugins", "../plugins", "..", "env"])
def test_a_plugin_moves_its_model_as_its_source_says(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, at = tmp_path / "worlds", tmp_path / "worlds" / place
    if place == "env":
        at = tmp_path / "elsewhere"
        monkeypatch.setenv("GAZEBO_PLUGIN_PATH", f"{tmp_path / 'none'}:{at / 'build'}")
    for needed in (folder, at):
        needed.mkdir(exist_ok=True)
    (at / "obs_3.cc").write_text(source(KEYS, 10.0))
    world = load(folder, CYLINDER)
    (mover,) = world.movers
    assert world.obstacles == 0
    assert (mover.name, mover.radius, mover.repeat) == ("obs", 0.5, Repeat.LOOP)
    for time, x, y in KEYS[:-1]:
        assert mover.position(time) == pytest.approx((x, y))
    assert mover.position(10.0) == pytest.approx((-10.0, 4.0))  # it jumps


def test_a_world_as_dynabarns_generator_writes_it(tmp_path: Path) -> None:
    wall = body("<box><size>.5 20 1</size></box>")
    walls = model(wall, "<static>1</static><pose frame=>-10 0 .5 0 0 0</pose>", name="back_wall")
    obstacles = [
        moving(f"<plugin name='libobs_{n}' filename='libobs_{n}.so'/>", f"libobs_{n}")
        .replace("<link", "<pose frame=''>-0.225 0.075 0 0 0 0</pose><link")
        .replace("<radius>0.1", "<radius>0.5000")
        for n in (3, 14)
    ]
    (tmp_path / "plugins").mkdir()
    for number in (3, 14):
        (tmp_path / "plugins" / f"obs_{number}.cc").write_text(source(KEYS, 10.0))
    world = load(tmp_path, walls, *obstacles)
    assert (len(world.segments), len(world.circles)) == (4, 0)
    assert [(mover.name, mover.radius) for mover in world.movers] == [
        ("libobs_3", 0.5),
        ("libobs_14", 0.5),
    ]
    assert world.movers[1].position(5.0) == pytest.approx((-5.0, 3.0))


@pytest.mark.parametrize(
    ("inside", "place", "radius"),
    [
        (body(PILLAR, pose(1, 2, 0.5, 0, 0, 0)), (-9.0, 6.0), 0.5),
        (body("<box><size>0.6 0.8 2</size></box>"), (-10.0, 4.0), 0.5),
        (body(PILLAR) + body(PILLAR, pose(1, 0, 0, 0, 0, 0)), (-10.0, 4.0), 1.5),
    ],
)
def test_a_mover_has_the_models_outline(
    inside: str, place: tuple[float, float], radius: float, tmp_path: Path
) -> None:
    (tmp_path / "obs_3.cc").write_text(source(KEYS, 10.0))
    whole = model(inside, pose(5, 5, 0, 0, 0, 1)).replace("</model>", f"{OBSTACLE}</model>")
    mover = load_one(tmp_path, whole)
    assert mover.position(0.0) == pytest.approx(place)
    assert mover.radius == pytest.approx(radius)
    floating = model(body(PILLAR, pose(0, 0, 9, 0, 0, 0))).replace(
        "</model>", f"{OBSTACLE}</model>"
    )
    assert load(tmp_path, floating).movers == ()


def test_an_animation_ends_with_its_length(tmp_path: Path) -> None:
    (tmp_path / "obs_3.cc").write_text(source(KEYS, 7.0, "false"))
    mover = load_one(tmp_path, CYLINDER)
    assert (mover.duration, mover.repeat) == (7.0, Repeat.STOP)
    (tmp_path / "obs_3.cc").write_text(source([(1.0, 2.0, 3.0), *KEYS[1:]], 12.0))
    mover = load_one(tmp_path, CYLINDER)
    assert mover.duration == 12.0
    assert mover.position(0.5) == pytest.approx((2.0, 3.0), abs=0.7)
    assert mover.position(12.0 - 1e-9) == pytest.approx((2.0, 3.0))  # back to the first frame


@pytest.mark.parametrize(
    "text",
    [
        "",
        source(KEYS[:1], 10.0),
        source(KEYS, 10.0).replace("5.00)", "t0 + i)"),
        source(KEYS, 10.0).replace("-5.00", "x[i]"),
        source(KEYS, 10.0).replace("PoseAnimation(", "Animation("),
        "CreateKeyFrame(" * 20_000,
    ],
)
def test_a_source_without_numbers_leaves_the_model_standing_and_named(
    text: str, tmp_path: Path
) -> None:
    assert sdf_motions.parse_keys(text) is None
    (tmp_path / "obs_3.cc").write_text(text)
    (tmp_path / "hall.world").write_bytes(sdf_of(CYLINDER))
    with pytest.warns(AcsarWarning, match=r"model 'obs' \(plugin 'libobs_3.so'\) stands where"):
        world = files.load_world(tmp_path / "hall.world", ENDS)
    assert (len(world.circles), world.movers) == (1, ())
