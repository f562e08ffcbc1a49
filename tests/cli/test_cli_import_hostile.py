"""`casadi-ik import` of hostile files: one line, within a bounded time, and no code is executed."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import Command

import casadi_ik as ik

NAMESPACE = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'

ROBOT = """<robot name="hand" {namespace}>{head}
<link name="palm"/><link name="left_1"/><link name="left_2"/><link name="right_1"/>
<link name="right_2"/>
<joint name="a" type="revolute"><parent link="palm"/><child link="left_1"/>
<origin xyz="0 0.04 {place}"/><axis xyz="1 0 0"/><limit lower="0" upper="1.5" velocity="1"/></joint>
<joint name="b" type="revolute"><parent link="left_1"/><child link="left_2"/>
<origin xyz="0 0 0.05"/><axis xyz="1 0 0"/><limit lower="0" upper="1.5" velocity="1"/></joint>
<joint name="c" type="revolute"><parent link="palm"/><child link="right_1"/>
<origin xyz="0 -0.04 0.1"/><axis xyz="-1 0 0"/><limit lower="0" upper="1.5" velocity="1"/></joint>
<joint name="d" type="revolute"><parent link="right_1"/><child link="right_2"/>
<origin xyz="0 0 0.05"/><axis xyz="-1 0 0"/><limit lower="0" upper="1.5" velocity="1"/></joint>
</robot>"""


def robot(path: Path, head: str = "", place: str = "0.1") -> Path:
    """Write a hand of two fingers; its text may contain macros."""
    path.write_text(ROBOT.format(namespace=NAMESPACE, head=head, place=place))
    return path


SYSTEM = (
    "${{(lambda: [c for c in ().__class__.__base__.__subclasses__() "
    "if c.__name__ == '_wrap_close'][0].__init__.__globals__['system']('touch {mark}'))()}}"
)

ATTACKS = {
    "classes": SYSTEM,
    "in a property": '<xacro:property name="x" value="' + SYSTEM + '"/>${{x}}',
    "generator": "${{[f('touch {mark}') for f in [print.__self__.__import__('os').system]]}}",
    "of a function": "${{round.__self__.__import__('os').system('touch {mark}')}}",
    "of math": "${{math.pi.__class__.__base__.__subclasses__()}}",
    "getattr": "${{python.type(1).mro()}}",
    "format": "${{'{{0.__class__}}'.format(1)}}",
    "interpolated": "${{f'{{(1).__class__}}'}}",
    "map": "${{list(map(python.vars, [pi]))}}",
    "yaml": "${{xacro.load_yaml('{secret}')}}",
    "yaml of old": "${{load_yaml('{secret}')}}",
    "eval": "$(eval ().__class__.__base__.__subclasses__())",
    "eval of math": "$(eval pow.__self__.__loader__)",
    "environment": "$(env CASADI_IK_SECRET)",
    "environment in eval": "$(eval env('CASADI_IK_SECRET'))",
    "include": '<xacro:include filename="{secret}"/>',
    "package": '<xacro:include filename="$(find etc)/passwd"/>',
}


@pytest.mark.parametrize(
    ("attack", "name"),
    [
        *((attack_name, name) for attack_name in ATTACKS for name in ("x.urdf", "x.xacro")),
        ("classes", "asked"),
    ],
)
def test_files_neither_run_code_nor_read_other_files(
    run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, attack: str, name: str
) -> None:
    monkeypatch.setenv("CASADI_IK_SECRET", "hush")
    (tmp_path / "elsewhere").mkdir()
    secret, mark = tmp_path / "elsewhere" / "secret.yaml", tmp_path / "mark"
    secret.write_text("hush: [hush")
    (tmp_path / "robots" / "mine").mkdir(parents=True)
    text = ATTACKS[attack].format(mark=mark, secret=secret)
    if name == "x.urdf" and "xacro:" not in text:  # nothing of it is looked at but where it counts
        path = robot(tmp_path / "robots" / "mine" / name, place=text.replace('"', "'"))
    else:
        path = robot(tmp_path / "robots" / "mine" / "x.urdf", head=f"<material>{text}</material>")
        path = path.rename(path.with_name(name)) if name != "asked" else path
    words = ("--xacro",) if name == "asked" else ()
    done = run("import", path, "--out", tmp_path / "mine.yaml", *words)
    assert path.name in done.error
    assert "hush" not in done.error
    assert not mark.exists()
    assert not (tmp_path / "mine.yaml").exists()


GROWING = {
    "power": '<link name="${9 ** 9 ** 9 ** 9}"/>',
    "text": "<link name=\"${len('a' * 10 ** 12)}\"/>",
    "macros": "".join(
        f'<xacro:macro name="m{i}">{f"<xacro:m{i - 1}/>" * 9 if i else "<x/>"}</xacro:macro>'
        for i in range(30)
    )
    + "<xacro:m29/>",
    "itself": '<xacro:macro name="m"><xacro:m/><xacro:m/></xacro:macro><xacro:m/>',
}


@pytest.mark.slow
@pytest.mark.parametrize("case", GROWING)
def test_exponential_macros_are_refused(
    run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    monkeypatch.setenv("CASADI_IK_LIMITS", "0.1")
    path = robot(tmp_path / "x.xacro", GROWING[case])
    assert run("import", path, "--out", "a.yaml").error.startswith(f"{path}: ")


def test_macros_are_expanded_with_the_option(run: Command, tmp_path: Path) -> None:
    pytest.importorskip("pinocchio")
    path, out = robot(tmp_path / "hand.urdf", place="${0.05 * 2}"), tmp_path / "mine.yaml"
    head = '<xacro:property name="unused" value="1"/>'
    assert "import it with --xacro" in run("import", robot(path, head), "--out", out).error
    robot(path, head, "${0.05 * 2}")
    assert run("import", path, "--xacro", "--out", out, "--check").exit == 0
    imported_robot = ik.load_robot(out)  # which goes by what stands in the description
    assert imported_robot.links(imported_robot.home)["left_1"][2, 3] == pytest.approx(
        0.1, abs=1e-15
    )
    assert "  xacro: true\n" in out.read_text()


HEAD = """<xacro:arg name="side" default="left"/>
<xacro:property name="sizes" value="${xacro.load_yaml('sizes.yaml')}"/>
<xacro:property name="long" value="${sizes['hand']['long']}"/>
<xacro:include filename="$(find its_parts)/urdf/parts.xacro"/>
<xacro:if value="${'$(arg side)' == 'left' and not long &lt; 0}">
<xacro:part name="more"/></xacro:if>
"""


@pytest.mark.parametrize("lead", ["ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH", "beside"])
def test_standard_xacro_constructs_are_expanded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Command, lead: str
) -> None:
    """Properties, arguments, conditions, YAML files of the folder, and packages are expanded."""
    pytest.importorskip("pinocchio")
    urdf_folder = tmp_path / "robots" / "hand" / "urdf"
    urdf_folder.mkdir(parents=True)
    (urdf_folder / "sizes.yaml").write_text("hand: {long: 0.05, angle: !degrees 90}\n")
    place = "${max(long, 0.01) * 2 * sin(sizes.hand.angle) + (0 if true else 1)}"
    path = robot(
        urdf_folder / "hand.xacro", HEAD.replace("true", "True"), place.replace("true", "True")
    )
    packages = {
        "ROS_PACKAGE_PATH": tmp_path / "src",
        "AMENT_PREFIX_PATH": tmp_path / "prefix" / "share",
        "beside": tmp_path / "robots",
    }
    part = packages[lead] / "its_parts" / "urdf"
    out = tmp_path / "mine.yaml"
    if lead != "beside":
        assert "package 'its_parts' is not found" in run("import", path, "--out", out).error
        folder = packages[lead].parent if lead.startswith("AMENT") else packages[lead]
        monkeypatch.setenv(lead, f"{tmp_path}:{folder}")
    part.mkdir(parents=True)
    (part.parent / "package.xml").write_text("<package/>")
    (part / "parts.xacro").write_text(
        f'<robot {NAMESPACE}><xacro:macro name="part" params="name"><link name="${{name}}"/>'
        '<joint name="${name}_fixed" type="fixed"><parent link="palm"/><child link="${name}"/>'
        "</joint></xacro:macro></robot>"
    )
    run("import", path, "--out", out, "--check").fine()
    imported_robot = ik.load_robot(out)
    assert imported_robot.links(imported_robot.home)["left_1"][2, 3] == pytest.approx(0.1)
    assert "more" in imported_robot.links(imported_robot.home)


def test_oversized_robots_are_refused(run: Command, tmp_path: Path) -> None:
    path, out = robot(tmp_path / "x.urdf"), tmp_path / "mine.yaml"
    plain, end = path.read_text().removesuffix("</robot>"), tmp_path / "other.yaml"
    ends = '<joint name="j{0}" type="{1}"><parent link="palm"/><child link="x{0}"/>'
    template = f'<link name="x{{0}}"/>{ends}<limit lower="0" upper="1" velocity="1"/></joint>'
    fixed, fingers = (
        "".join(template.format(i, kind) for i in range(1200)) for kind in ("fixed", "revolute")
    )
    for added, says in ((fixed, "1205 links"), (fingers[: fingers.index("x300")], "304 moving jo")):
        text = added[: added.rindex("<link")] if added is not fixed else added
        path.write_text(f"{plain}{text}</robot>")
        assert f"x.urdf: found {says}" in run("import", path, "--out", out).error
    path.write_text(f"{plain}{fixed}</robot>")
    assert run("import", path, "--size-limits", "2", "--out", end).exit == 0


TAG, AXIS, PLACE, LIMIT = (
    *('<robot name="hand"', '<axis xyz="1 0 0"/>', 'xyz="0 0.04 0.1"', 'lower="0" upper="1.5"'),
)

NUMBERS = {
    "encoding": (TAG, f'<?xml version="1.0" encoding="utf-7"?>{TAG}', ""),
    "unknown encoding": (TAG, f'<?xml version="1.0" encoding="x"?>{TAG}', ""),
    "limits without end": (LIMIT, 'lower="-1e308" upper="1e308"', ""),
    "no axis": (AXIS, "<axis/>", ""),
    "axis": (AXIS, '<axis xyz="1e308 0 0"/>', "axis: xyz: found '1e308 0 0'"),
    "place": (PLACE, 'xyz="0 0 1e308"', "origin: xyz: found '0 0 1e308'"),
    "NaN": (LIMIT, 'lower="0" upper="nan"', "limit: upper: found 'nan'"),
}


@pytest.mark.parametrize("case", NUMBERS)
def test_urdf_numbers_and_encodings(run: Command, tmp_path: Path, case: str) -> None:
    pytest.importorskip("pinocchio")
    path = robot(tmp_path / "x.urdf")
    old, new, says = NUMBERS[case]
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    done = run("import", path, "--out", tmp_path / "mine.yaml", "--check")
    if says:
        assert f"x.urdf: joint 'a': {says}" in done.error
    else:
        assert (done.exit, done.err) == (0, ""), done


MJCF = """<mujoco><compiler angle="radian"/>{assets}<worldbody><body name="palm">{bodies}
<body name="l1" pos="0 0.04 0.1"><joint name="a" axis="{axis}" range="{range}" limited="true"/>
<geom size="0.01"/><body name="l2" pos="0 0 {place}"><joint name="b" axis="1 0 0" range="0 1"
limited="true"/><geom size="0.01"/></body></body>
<body name="r1" pos="0 -0.04 0.1"><joint name="c" axis="-1 0 0" range="0 1" limited="true"/>
<geom size="0.01"/></body></body></worldbody>
<tendon><fixed name="t"><joint joint="a" coef="{pull}"/><joint joint="b" coef="{pull}"/></fixed>
</tendon><actuator><position tendon="t"/></actuator></mujoco>"""

PLAIN = {"assets": "", "bodies": "", "axis": "1 0 0", "range": "0 1", "place": "0.05", "pull": "1"}

GIANTS = "takes more than 2 s of computing or 307 MiB (--size-limits 4, or CASADI_IK_LIMITS=4"

MODELS = {
    "plain": ({}, ""),
    "field": (
        {"assets": '<asset><hfield name="h" nrow="38000" ncol="38000" size="1 1 1 1"/></asset>'},
        GIANTS,
    ),
    "replicated": (
        {"bodies": '<replicate count="1000000"><body><geom size="0.1"/></body></replicate>'},
        GIANTS,
    ),
    "axis is NaN": ({"axis": "nan 0 0"}, "jnt_axis: "),
    "axis is infinite": ({"axis": "inf 0 0"}, "jnt_axis: "),
    "axis overflows": ({"axis": "1e308 0 0"}, "jnt_axis: "),
    "place is NaN": ({"place": "nan"}, "body_pos: "),
    "place is far": ({"place": "1e308"}, "body_pos: "),
    "range is NaN": ({"range": "nan 1"}, "jnt_range: "),
    "range is infinite": ({"range": "-inf inf"}, ""),
    "range is wide": ({"range": "-1e308 1e308"}, ""),
    "tendon that pulls nothing": ({"pull": "0"}, ""),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", MODELS)
def test_mjcf_numbers_and_oversized_models(
    run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    changes, says = MODELS[case]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CASADI_IK_LIMITS", "0.1" if says == GIANTS else "1")
    Path("x.xml").write_text(MJCF.format(**PLAIN | changes))
    done = run("import", "x.xml", "--palm", "palm", "--out", "mine.yaml", "--check")
    if says:
        assert done.error.startswith("x.xml: ")
        assert says in done.error
    else:
        assert (done.exit, done.err) == (0, ""), done
    assert {path.name for path in tmp_path.iterdir()} <= {"x.xml", "mine.yaml"}
