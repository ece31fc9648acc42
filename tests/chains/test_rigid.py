import math
import re

import numpy as np
import pytest
import torch
from lxml import etree
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from hybridkin import InverseKinematics, RigidChain, calibrate
from hybridkin._core.model import reverse_jacobian

Z = [0.0, 0.0, 1.0]

# Seven revolute joints and one prismatic, a fixed one before, between and after them, a branch.
URDF = """<?xml version="1.0" encoding="utf-8"?>
<robot name="arm">
  <link name="world"/><link name="base"/><link name="l1"/><link name="l2"/><link name="l3"/>
  <link name="l4"/><link name="plate"/><link name="l5"/><link name="l6"/><link name="l7"/>
  <link name="l8"/><link name="flange"/><link name="camera"/>
  <joint name="mount" type="fixed"><parent link="world"/><child link="base"/>
    <origin xyz="0.1 -0.2 0.3" rpy="0.1 0.2 -0.3"/></joint>
  <joint name="j1" type="revolute"><parent link="base"/><child link="l1"/>
    <origin xyz="0 0 0.33"/><axis xyz="0 0 1"/>
    <limit lower="-2.8" upper="2.7" effort="1" velocity="1"/></joint>
  <joint name="j2" type="continuous"><parent link="l1"/><child link="l2"/>
    <origin xyz="0.01 0 0" rpy="-1.5707963 0 0"/><axis xyz="0 0 2"/></joint>
  <joint name="j3" type="prismatic"><parent link="l2"/><child link="l3"/>
    <origin xyz="0 -0.3 0" rpy="1.5707963 0 0.4"/><axis xyz="0.6 0 0.8"/>
    <limit lower="0" upper="0.4" effort="1" velocity="1"/></joint>
  <joint name="j4" type="continuous"><parent link="l3"/><child link="l4"/>
    <origin xyz="0.08 0 0" rpy="1.57 0 0"/><axis xyz="0 1 0"/>
    <limit effort="1" velocity="1"/></joint>
  <joint name="screws" type="fixed"><parent link="l4"/><child link="plate"/>
    <origin xyz="0 0 0.05" rpy="0 0.3 0"/></joint>
  <joint name="j5" type="continuous"><parent link="plate"/><child link="l5"/>
    <origin xyz="-0.08 0.38 0" rpy="-1.57 0 0"/><axis xyz="0 0 1"/></joint>
  <joint name="j6" type="continuous"><parent link="l5"/><child link="l6"/>
    <origin rpy="1.57 0 0"/><axis xyz="-1 0 0"/></joint>
  <joint name="j7" type="continuous"><parent link="l6"/><child link="l7"/>
    <origin xyz="0.09 0 0" rpy="1.57 0 0"/><axis xyz="0 0.28 0.96"/></joint>
  <joint name="j8" type="continuous"><parent link="l7"/><child link="l8"/>
    <origin xyz="0 0 0.1"/><axis xyz="1 0 0"/></joint>
  <joint name="weld" type="fixed"><parent link="l8"/><child link="flange"/>
    <origin xyz="0 0.02 0.1" rpy="0 0 0.7"/></joint>
  <joint name="bracket" type="fixed"><parent link="l4"/><child link="camera"/></joint>
</robot>
"""

# Anchors beside the bodies' origins, a reference angle, two joints in one body.
MJCF = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="pedestal" pos="0.1 0.2 0.3" euler="0.1 0.2 0.3">
      <body name="upper" pos="0 0 0.1">
        <joint name="turn" axis="0 0 1" pos="0.05 0 0" range="-2 2.5" limited="true"/>
        <geom size="0.01"/>
        <body name="lower" pos="0.2 0 0" euler="0 0.5 0">
          <joint name="slide" type="slide" axis="1 0 1" ref="0.1"/>
          <joint name="lift" axis="0 1 0" pos="-0.02 0 0.03" ref="0.4"/>
          <geom size="0.01"/>
          <body name="hand" pos="0 0 0.3">
            <joint name="wrist" axis="1 0.2 0"/>
            <geom size="0.01"/>
            <site name="fingertip" pos="0.01 0.02 0.1" euler="0 0 0.3"/>
          </body>
        </body>
      </body>
    </body>
    <body name="ball"><freejoint/><geom size="0.01"/>
      <body name="pin"><joint name="pin"/><geom size="0.01"/></body></body>
  </worldbody>
</mujoco>
"""


def translation(x, y, z):
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def planar(**options):
    origins = [np.eye(4), translation(0.3, 0.0, 0.0)]
    return RigidChain(origins, [Z, Z], **{"tool": [0.2, 0.0, 0.0], **options})


def arm(**options):
    return RigidChain.from_urdf(URDF, "flange", **options)


def random_q(rng, n=20, size=8):
    return 2 * torch.rand(n, size, generator=rng, dtype=torch.float64) - 1


def random_pose(rng):
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=rng, dtype=torch.float64))[0]
    matrix[:3, :3] *= torch.linalg.det(matrix[:3, :3])
    matrix[:3, 3] = torch.randn(3, generator=rng, dtype=torch.float64)
    return matrix


def test_planar_arm_in_closed_form(rng):
    q = random_q(rng, size=2)
    a, b = q[:, 0], q.sum(1)
    zero = torch.zeros_like(a)
    elbow = 0.3 * torch.stack([a.cos(), a.sin(), zero], -1)
    tip = elbow + 0.2 * torch.stack([b.cos(), b.sin(), zero], -1)
    x, J = planar().forward_and_jacobian(q)
    columns = [torch.stack([-v[:, 1], v[:, 0], zero], -1) for v in (tip, tip - elbow)]
    assert_close(x, tip, rtol=0, atol=1e-15)
    assert_close(J, torch.stack(columns, -1), rtol=0, atol=1e-15)
    angular = torch.tensor(Z, dtype=torch.float64)[:, None].expand(len(q), 3, 2)
    assert_close(planar().pose_jacobian(q)[:, 3:], angular, rtol=0, atol=1e-15)


def test_urdf_against_pytorch_kinematics(rng):
    kinematics = pytest.importorskip("pytorch_kinematics")
    serial = kinematics.build_serial_chain_from_urdf(URDF.encode(), "flange")
    serial = serial.to(dtype=torch.float64)
    q = random_q(rng, 300)
    J, T = serial.jacobian(q, ret_eef_pose=True)
    # It reads files in single precision.
    for chain in (arm(), RigidChain.from_chain(serial)):
        assert_close(chain(q), T[:, :3, 3], rtol=0, atol=2e-6)
        assert_close(chain.tip_transform(q).get_matrix(), T, rtol=0, atol=2e-6)
        assert_close(chain.pose_jacobian(q), J, rtol=0, atol=2e-6)
        assert chain.names == tuple(serial.get_joint_parameter_names())
    links = serial.forward_kinematics(q, end_only=False)
    expected = torch.stack([links[f"l{k}"].get_matrix() for k in range(1, 8)], 1)
    assert_close(arm().poses(q)[:, 1:-1], expected, rtol=0, atol=2e-6)


def test_urdf_is_read_to_double_precision_with_limits_and_names():
    chain = arm()
    assert chain.origins[1, 0, 3].item() == 0.01
    turn, tilt = math.cos(0.4), 1.5707963
    expected = [turn * math.cos(tilt), -turn * math.sin(tilt)]
    rotation = torch.tensor(expected, dtype=torch.float64)
    assert_close(chain.origins[2, 1, 1:3], rotation, rtol=0, atol=3e-16)
    assert chain.q_min.tolist() == [-2.8, -math.inf, 0.0] + [-math.inf] * 5
    assert chain.q_max.tolist() == [2.7, math.inf, 0.4] + [math.inf] * 5
    assert chain.kinds == ("revolute", "revolute", "prismatic", *["revolute"] * 5)
    assert chain.names == tuple(f"j{k}" for k in range(1, 9))
    text = LINKS.format(JOINT.format("continuous", ""))  # without <axis> it is x
    x = RigidChain.from_urdf(text, "b", tool=[0, 1, 0])(torch.tensor([math.pi / 2]).double())
    assert_close(x, torch.tensor(Z, dtype=torch.float64), rtol=0, atol=1e-7)


@pytest.mark.parametrize(("end", "tool"), [("fingertip", [0.0, 0.0, 0.0]), ("hand", [0.1, 0, 0.2])])
def test_mjcf_against_mujoco(end, tool, rng):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    chain = RigidChain.from_mjcf(MJCF, end, tool=tool)
    assert chain.names == ("turn", "slide", "lift", "wrist")
    for q in random_q(rng, 5, 4):
        data.qpos[:4] = q.numpy()
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        place = data.site(end) if end == "fingertip" else data.body(end)
        rotation = place.xmat.reshape(3, 3)
        x = place.xpos + rotation @ tool
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, linear, angular, x, model.body("hand").id)
        J = np.concatenate([linear, angular])[:, :4]
        assert_close(chain(q).numpy(), x, rtol=0, atol=1e-14)
        assert_close(chain.poses(q)[-1, :3, :3].numpy(), rotation, rtol=0, atol=1e-14)
        assert_close(chain.pose_jacobian(q).numpy(), J, rtol=0, atol=1e-14)


def test_gradcheck(rng):
    chain, q = arm(tool=[0.1, 0.02, 0.2], root_link="plate"), random_q(rng, 2, 4)
    q[0] = 0.0
    q.requires_grad_()
    assert torch.autograd.gradcheck(chain.forward_and_jacobian, q)
    assert torch.autograd.gradgradcheck(chain, q)


def test_angular_jacobian_turns_the_tip_frame(rng):
    chain, q = arm(base=random_pose(rng)), random_q(rng, 5)
    frame, angular = chain.poses(q)[:, -1, :3, :3], chain.pose_jacobian(q)[:, 3:]
    slope = torch.func.vmap(torch.func.jacfwd(lambda q: chain.poses(q)[-1, :3, :3]))(q)
    spin = slope.permute(0, 3, 1, 2) @ frame[:, None].mT
    expected = torch.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], 1)
    assert_close(angular, expected, rtol=0, atol=4e-15)
    pose, J = chain.pose_and_jacobian(q)
    assert_close(pose, chain.pose(q), rtol=0, atol=2e-15)
    assert_close(J[:, :3], chain.jacobian(q), rtol=0, atol=0)
    assert_close(chain.pose_and_jacobian(q[0])[0], pose[0])


LINKS = '<robot name="r"><link name="a"/><link name="b"/>{}</robot>'
JOINT = '<joint name="j" type="{}"><parent link="a"/><child link="b"/>{}</joint>'
SECOND = JOINT.replace('"j"', '"k"').format("fixed", "")


@pytest.mark.parametrize(
    ("read", "message"),
    [
        (lambda: RigidChain.from_urdf("<robot", "a"), "valid URDF"),
        (lambda: RigidChain.from_urdf("<sdf/>", "a"), "got <sdf>"),
        (
            lambda: RigidChain.from_urdf(f'<!DOCTYPE robot [<!ENTITY a "b">]>{URDF[39:]}', "l1"),
            r"without DOCTYPE, .* got '<!DOCTYPE robot>'; remove it",
        ),
        (lambda: RigidChain.from_urdf(URDF, "flang"), "`end_link` .* did you mean 'flange'"),
        (lambda: arm(root_link="?"), "`root_link` '[?]' is not in the robot; it has"),
        (lambda: arm(root_link="camera"), "`root_link` must lead to 'flange'"),
        (lambda: urdf(JOINT.format("ball", "")), "`type` of joint 'j' .* got 'ball'"),
        (lambda: urdf(JOINT.format("revolute", '<mimic joint="j"/>')), "in a circle"),
        (
            lambda: urdf(JOINT.format("fixed", '<origin xyz="1 2"/>')),
            "`xyz` of <origin> .* 3 numbers",
        ),
        (lambda: urdf(JOINT.format("fixed", "") + SECOND), "every <child> .* 'b' repeatedly"),
        (lambda: urdf(JOINT.format("fixed", "") + SECOND.replace('"k"', '"j"')), "every joint"),
        (lambda: urdf(JOINT.replace('"a"', '"b"').format("fixed", "")), "got a cycle"),
        (lambda: urdf(one_joint("nan", 1)), "`q_min` must be finite"),
    ],
)
def test_broken_urdfs_are_refused(read, message):
    with pytest.raises(ValueError, match=message):
        read()


def urdf(joints):
    return RigidChain.from_urdf(joints if "<robot" in joints else LINKS.format(joints), "b")


def one_joint(low, high):
    limit = f'<limit lower="{low}" upper="{high}" effort="1" velocity="1"/>'
    return LINKS.format(JOINT.format("revolute", limit))


def test_equal_missing_and_swapped_limits_of_a_urdf():
    assert urdf(one_joint(0.3, 0.3)).limits["q_min"] == urdf(one_joint(0.3, 0.3)).q_max == 0.3
    with pytest.warns(UserWarning, match="'j' is locked") as caught:
        locked = urdf(one_joint(0, 0))
    assert caught[0].filename == __file__
    assert locked.q_min == locked.q_max == 0.0
    with pytest.warns(UserWarning, match="'j' has no <limit>"):
        free = urdf(JOINT.format("revolute", ""))
    assert (float(free.q_min), float(free.q_max)) == (-math.inf, math.inf)
    with pytest.warns(UserWarning, match="'j' are swapped"):
        swapped = urdf(one_joint(1, -1))
    assert (float(swapped.q_min), float(swapped.q_max), float(swapped.dq_max)) == (-1, 1, 1)
    still = urdf(one_joint(-1, 1).replace('velocity="1"', 'velocity="0"'))
    assert still.dq_max == math.inf


@pytest.mark.parametrize(
    ("text", "end", "root", "message"),
    [
        ("<mujoco>", "hand", None, "valid MJCF"),
        (MJCF, "hant", None, "`end_link` .* did you mean 'hand'"),
        (MJCF, "hand", "hend", "`root_link` .* did you mean 'hand'"),
        (MJCF, "hand", "ball", "`root_link` must lead to 'hand'"),
        (MJCF, "pin", None, "of body 'ball' is free or a ball"),
    ],
)
def test_bad_mjcf_says_what_is_needed(text, end, root, message):
    pytest.importorskip("mujoco")
    with pytest.raises(ValueError, match=message):
        RigidChain.from_mjcf(text, end, root_link=root)


TENDON_ARM = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="one"><joint name="one" axis="0 1 0" ref="0.2"/><geom size="0.01"/>
      <body name="two" pos="0 0 0.3">
        <joint name="two" axis="1 0 0.3" pos="0.01 0 0" ref="-0.1"/><geom size="0.01"/>
        <body name="three" pos="0.1 0 0.2">
          <joint name="three" type="slide" axis="0 0 1" range="-0.1 0.1" limited="true"/>
          <geom size="0.01"/>
          <body name="hand" pos="0 0.1 0.1"><joint name="four" axis="0 1 0"/>
            <geom size="0.01"/></body>
        </body>
      </body>
    </body>
    <body name="motor"><joint name="motor" range="-1 1.5" limited="true" ref="0.4"/>
      <geom size="0.01"/></body>
  </worldbody>
  <tendon>
    <fixed name="pair"><joint joint="one" coef="1"/><joint joint="two" coef="0.5"/></fixed>
  </tendon>
  {}
</mujoco>
"""
CIRCLE = '<joint joint1="one" joint2="two"/><joint joint1="two" joint2="one"/>'
PULLED = '<actuator><position tendon="pair"/>{}</actuator>'


def coupled(equality="", other=""):
    return TENDON_ARM.format(f"<equality>{equality}</equality>{other}")


def test_joints_that_an_equality_couples_follow_their_driver(rng):
    """Against MuJoCo at positions that satisfy the constraints, of joints with references."""
    mujoco = pytest.importorskip("mujoco")
    text = coupled(
        '<joint joint1="two" joint2="one" polycoef="0.3 -0.7 0 0 0"/>'
        '<joint joint1="one" joint2="motor" polycoef="-0.1 1.5 0 0 0"/>'
        '<joint joint1="four" polycoef="0.25 0 0 0 0"/>'
        '<joint joint1="three" joint2="motor" polycoef="0 0 1 0 0" active="false"/>'
    )
    chain = RigidChain.from_mjcf(text, "hand")
    assert chain.names == ("motor", "three")
    assert_close(chain.q_min, torch.tensor([-1.0, -0.1], dtype=torch.float64))
    assert_close(chain.q_max, torch.tensor([1.5, 0.1], dtype=torch.float64))
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    for motor, three in random_q(rng, size=2).tolist():
        one = 0.2 - 0.1 + 1.5 * (motor - 0.4)
        two = -0.1 + 0.3 - 0.7 * (one - 0.2)
        for name, value in dict(one=one, two=two, three=three, four=0.25, motor=motor).items():
            data.joint(name).qpos[0] = value
        mujoco.mj_fwdPosition(model, data)
        assert np.abs(data.efc_pos[:3]).max() < 1e-12, "the constraints hold"
        tip = chain(torch.tensor([motor, three], dtype=torch.float64))
        assert_close(tip, torch.from_numpy(data.body("hand").xpos), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (coupled('<joint name="bent" joint1="two" joint2="one" polycoef="0 1 2 0 0"/>'), "bent"),
        (coupled(2 * '<joint joint1="two" joint2="one"/>'), "'two' must follow one other"),
        (coupled(CIRCLE), r"in a circle, got \['one', 'two'\]"),
        (coupled("", PULLED.format("")), r"'pair' moves the joints \['one', 'two'\]"),
    ],
)
def test_couplings_that_kinematics_do_not_know_are_refused(text, message):
    pytest.importorskip("mujoco")
    with pytest.raises(ValueError, match=message):
        RigidChain.from_mjcf(text, "hand")


def test_a_fixed_tendon_whose_joints_are_known_is_no_matter():
    pytest.importorskip("mujoco")
    driven = coupled("", PULLED.format('<position joint="two"/>'))
    assert RigidChain.from_mjcf(driven, "hand").n_actuators == 4
    joined = coupled('<joint joint1="two" joint2="one"/>', PULLED.format(""))
    assert RigidChain.from_mjcf(joined, "hand").names == ("one", "three", "four")
    assert RigidChain.from_mjcf(coupled(), "hand").n_actuators == 4


def test_a_loop_is_named():
    pytest.importorskip("mujoco")
    tied = coupled('<connect body1="two" body2="motor" anchor="0 0 0"/>')
    with pytest.warns(UserWarning, match="body 'two' is tied .* <connect>") as caught:
        assert RigidChain.from_mjcf(tied, "hand").n_actuators == 4
    assert caught[0].filename == __file__


def test_quaternions_of_a_urdf_are_poses(rng):
    """As the angles of the same rotation, and written back as angles."""
    for _ in range(20):
        turn = Rotation.from_rotvec(torch.randn(3, generator=rng).numpy())
        quaternion = " ".join(map(repr, (3.0 * turn.as_quat()).tolist()))
        limit = '<limit lower="-1" upper="1"/><origin xyz="1 2 3" quat_xyzw="{}"/>'
        text = LINKS.format(JOINT.format("revolute", limit.format(quaternion)))
        arm = urdf(text)
        assert_close(arm.origins[0, :3, :3], torch.from_numpy(turn.as_matrix()))
        placed = arm.with_geometry(links=arm.geometry()["links"] + 0.1)
        again = urdf(placed.to_urdf(text, "b"))
        assert_close(again.origins, placed.origins, rtol=0, atol=1e-14)


@pytest.mark.parametrize("origin", ['rpy="0 0 0" quat_xyzw="0 0 0 1"', 'quat_xyzw="0 0 0 0"'])
def test_a_urdf_has_one_rotation_for_a_joint(origin):
    joint = JOINT.format("continuous", f"<origin {origin}/>")
    with pytest.raises(ValueError, match="must have either `rpy` or `quat_xyzw`"):
        urdf(LINKS.format(joint))


@pytest.mark.parametrize(
    ("limit", "acceleration"),
    [
        ('acceleration="3"', 3.0),
        ('acceleration="3" deceleration="2"', 2.0),
        ('deceleration="4"', 4.0),
        ('acceleration="0"', math.inf),
        ("", math.inf),
    ],
)
@pytest.mark.parametrize("kind", ["revolute", "continuous"])
def test_accelerations_of_a_urdf_limit_inverse_kinematics(kind, limit, acceleration):
    tags = f'<limit lower="-1" upper="1" {limit}/>'
    arm = urdf(LINKS.format(JOINT.format(kind, tags)))
    assert arm.ddq_max == InverseKinematics(arm).settings.ddq_max == acceleration
    assert InverseKinematics(arm, ddq_max=7.0).settings.ddq_max == 7.0


def test_degrees_and_millimetres_are_noticed():
    slider = planar(kinds=["revolute", "prismatic"])
    (message,) = slider.check_actuators(torch.tensor([[90.0, 0.1]]))
    assert "`q` reaches 90 on a revolute joint, which looks like degrees" in message
    (message,) = slider.check_actuators(torch.tensor([[0.9, 100.0]]), "X")
    assert "`X` reaches 100, which looks like millimetres" in message
    with pytest.warns(UserWarning, match="millimetres"):
        RigidChain.from_urdf(URDF.replace("0.33", "330"), "flange")
    assert slider.check_actuators(torch.tensor([[-6.0, 0.1]])) == []


def joint(name, parent, child, kind, *tags):
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{"".join(tags)}</joint>'


LIMIT = '<limit lower="-1" upper="2" effort="1" velocity="3"/>'

# "k" mimics "m" beside the path, "l" mimics "k"; "n" is an actuator of its own.
COUPLED = f"""<!-- kept --><robot xmlns:v="x" name="coupled"><v:paint rgb="1 0 0"/>
<link name="a"/><link name="b"/><link name="c"/><link name="d"/><link name="e"/><link name="f"/>
<transmission name="t"><joint name="not a joint"/></transmission>
{joint("m", "a", "b", "prismatic", LIMIT)}
{
    joint(
        "k",
        "a",
        "c",
        "revolute",
        LIMIT,
        '<axis xyz="0 0 1"/>',
        '<mimic joint="m" multiplier="2" offset="0.3"/>',
        '<origin xyz="0.1 0 0"/>',
    )
}
{joint("plate", "c", "d", "fixed", '<origin xyz="0 0 0.1" rpy="0.1 1.5707963267948966 0.3"/>')}
{
    joint(
        "l",
        "d",
        "e",
        "prismatic",
        LIMIT,
        '<mimic joint="k" multiplier="-0.5" offset="0.1"/>',
        '<gazebo reference="x"/>',
        '<axis xyz="0 3 4"/>',
    )
}
{joint("n", "e", "f", "continuous", '<origin xyz="0.2 0 0" rpy="0.4 0 0"></origin>')}
</robot>"""


def test_joints_that_mimic_others_are_one_actuator(rng):
    """Against the joints on their own; limits are those of the actuator; Jacobians sum columns."""
    arm = RigidChain.from_urdf(COUPLED, "f", tool=[0.1, 0.2, 0.3], base=random_pose(rng))
    alone = RigidChain.from_urdf(
        re.sub("<mimic.*?>", "", COUPLED), "f", tool=arm.tool, base=arm.base
    )
    q = random_q(rng, 7, 2)
    k = 2 * q[:, 0] + 0.3
    joints = torch.stack([k, 0.1 - 0.5 * k, q[:, 1]], 1)
    assert arm.names == ("m", "n")
    assert arm.unit_of_q == ["rad", "rad"]
    assert_close(arm.dq_max, torch.tensor([3.0, math.inf], dtype=torch.float64))
    assert_close(arm.q_min, torch.tensor([-1.0, -math.inf], dtype=torch.float64))
    assert_close(arm.poses(q), alone.poses(joints), rtol=0, atol=2e-15)
    assert_close(arm.backbone(q), alone.backbone(joints), rtol=0, atol=2e-15)
    slopes = torch.tensor([[2.0, 0], [-1.0, 0], [0, 1.0]], dtype=torch.float64)
    T, J = arm.pose_and_jacobian(q)
    assert_close(T, alone.pose(joints), rtol=0, atol=2e-15)
    assert_close(J, alone.pose_jacobian(joints) @ slopes, rtol=0, atol=4e-15)
    assert_close(arm.jacobian(q), reverse_jacobian(arm.forward, q)[1], rtol=0, atol=4e-15)
    z, dz = arm.coordinates(q)
    assert_close(dz, slopes)
    assert_close(arm.from_coordinates(z), arm(q))
    for ik in (
        InverseKinematics(arm, q_pref=0.0),
        InverseKinematics(arm, q_pref=0.0, limits="off"),
    ):
        assert ik.solve(arm(q[:1]), q0=q[:1] + 0.05).converged.all()


def test_floating_and_planar_joints_are_moves_and_turns():
    both = joint("p", "b", "c", "planar") + joint(
        "o", "a", "b", "floating", '<origin xyz="1 0 0"/>'
    )
    arm = RigidChain.from_urdf(LINKS.format('<link name="c"/>' + both), "c")
    names = ("o_x", "o_y", "o_z", "o_yaw", "o_pitch", "o_roll", "p_x", "p_y", "p_yaw")
    assert arm.names == names
    q = torch.linspace(-0.4, 0.9, 9, dtype=torch.float64)
    first, second = np.eye(4), np.eye(4)
    first[:3, :3] = Rotation.from_euler("ZYX", q[3:6]).as_matrix()
    first[:3, 3] = q[:3].numpy() + np.array([1.0, 0.0, 0.0])
    second[:3, :3] = Rotation.from_euler("Z", float(q[8])).as_matrix()
    second[:2, 3] = q[6:8].numpy()
    assert_close(arm.pose(q), torch.from_numpy(first @ second), rtol=0, atol=1e-15)
    with pytest.raises(ValueError, match="'o_x' is free"):
        arm.to_urdf(LINKS.format('<link name="c"/>' + both), "c")


def test_joints_of_equal_names_are_actuators_of_their_own():
    """A part of a planar joint beside a joint of its name, and a joint that mimics the latter."""
    text = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/><link name="d"/>"""
    text += joint("base", "a", "b", "planar") + joint("base_x", "b", "c", "revolute", LIMIT)
    text += joint("j", "c", "d", "revolute", LIMIT, '<mimic joint="base_x"/>') + "</robot>"
    arm = RigidChain.from_urdf(text, "d")
    assert arm.names == ("base_x", "base_y", "base_yaw", "base_x")
    assert arm.couplings.nonzero().tolist() == [[0, 0], [1, 1], [2, 2], [3, 3], [4, 3]]
    pytest.importorskip("mujoco")
    unnamed = MJCF.replace('name="lift"', "").replace('name="wrist"', "")
    assert RigidChain.from_mjcf(unnamed, "hand").n_actuators == 4
    kinematics = pytest.importorskip("pytorch_kinematics")
    chain = kinematics.build_serial_chain_from_urdf(URDF.encode(), "l3")
    for name in chain.get_frame_names():
        chain.find_frame(name).joint.name = "same"
    assert RigidChain.from_chain(chain).n_actuators == 3


def moved(arm, rng):
    """An arm with other links and zeros."""
    return changed(arm, ("links", "joint_zeros"), rng)


def changed(arm, names, rng):
    old = arm.geometry()
    new = {
        name: old[name] + 0.1 * torch.randn(old[name].shape, generator=rng, dtype=torch.float64)
        for name in names
    }
    return arm.with_geometry(**new)


def test_joint_zeros_are_where_q_starts(rng):
    plain, q, zeros = arm(), random_q(rng), torch.linspace(-0.3, 0.4, 8, dtype=torch.float64)
    chain = plain.with_geometry(joint_zeros=zeros)
    assert_close(chain.pose(q + zeros), plain.pose(q), rtol=0, atol=4e-15)
    assert_close(chain.jacobian(q + zeros), plain.jacobian(q), rtol=0, atol=4e-15)
    assert_close(arm(joint_zeros=zeros).poses(q), chain.poses(q), rtol=0, atol=0)
    given = {name: value.clone().requires_grad_() for name, value in plain.geometry().items()}

    def tip(links, joint_zeros):
        return plain.with_geometry(links=links, joint_zeros=joint_zeros)(q[:2])

    assert torch.autograd.gradcheck(tip, (given["links"], given["joint_zeros"]))


@pytest.mark.parametrize(("text", "end"), [(URDF, "flange"), (COUPLED, "f")])
def test_a_calibrated_urdf_is_read_as_the_calibrated_arm(text, end, tmp_path, rng):
    path = tmp_path / "arm.urdf"
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    tool = [0.1, 0.2, 0.3]
    chain = RigidChain.from_urdf(path, end, tool=tool)
    chain = changed(chain, ("links", "joint_zeros", "axes"), rng)
    written = chain.to_urdf(path, end)
    again, q = RigidChain.from_urdf(written, end, tool=tool), random_q(rng, 9, chain.n_actuators)
    assert_close(again.poses(q)[:, 1:], chain.poses(q)[:, 1:], rtol=0, atol=1e-12)
    assert_close(again.jacobian(q), chain.jacobian(q), rtol=0, atol=1e-12)
    assert again.to_urdf(written, end) == written
    # Nothing else has changed: comments, tags of vendors, the order, fixed joints.
    tags = re.compile("<(origin|axis)[^>]*>(</origin>)?")
    before = etree.tostring(etree.fromstring(text.encode()).getroottree(), encoding="unicode")
    assert tags.sub("", written) == tags.sub("", before)
    fixed = re.search('<joint name="(plate|mount)".*?</joint>', before, re.S)
    assert fixed[0] in written
    unturned = moved(RigidChain.from_urdf(path, end), rng).to_urdf(path, end)
    assert re.findall("<axis[^>]*>", unturned) == re.findall("<axis[^>]*>", before)
    assert RigidChain.from_urdf(text, end).to_urdf(text, end) == before


def test_a_pitch_of_ninety_degrees_is_written_exactly():
    """Beside it too, where roll and yaw nearly turn about the same axis."""
    text = LINKS.format(joint("j", "a", "b", "continuous", "<origin/>"))
    for off in (0.0, 1e-15, -1e-9, 1e-7, 1e-4):
        turn = Rotation.from_euler("xyz", [0.7, math.pi / 2 - off, 0.4]).as_matrix()
        pose = np.eye(4)
        pose[:3, :3] = turn
        chain = RigidChain(pose[None], [[1, 0, 0]], names=["j"])
        again = RigidChain.from_urdf(chain.to_urdf(text, "b"), "b")
        assert_close(again.origins, chain.origins, rtol=0, atol=1e-15)


@pytest.mark.slow
def test_calibration_finds_links_and_joint_zeros(rng):
    """Up to what the tips cannot identify: the tips of new postures, and a URDF that gives them."""
    nominal = arm(tool=[0.1, 0.05, 0.2], root_link="base")
    true, q = moved(nominal, rng), 1.5 * random_q(rng, 300)
    x = true(q) + 1e-4 * torch.randn(300, 3, generator=rng, dtype=torch.float64)
    result = calibrate(nominal, q, x, ("base", "joint_zeros", "links"))
    assert result.converged
    unseen = 1.5 * random_q(rng, 100)
    error = (result.chain(unseen) - true(unseen)).norm(dim=1)
    assert error.max() < 3e-4
    assert (nominal(unseen) - true(unseen)).norm(dim=1).mean() > 0.05
    assert result.std_errors["joint_zeros"].shape == (8,)
    assert result.identifiable["links"].shape == (8, 3)
    said = "\n".join(result.unidentified)
    for link in (0, 1):  # three lengths along one line; the first is named in both sentences
        assert f"base[z] +1 mm with links[{link}, z] -1 mm does not move the tips" in said
    assert re.search(r"base\[rot z\] \+1 deg with .*joint_zeros\[0\] \+1 deg", said)
    text = result.chain.to_urdf(URDF, "flange", root_link="base")
    options = {name: getattr(result.chain, name) for name in ("base", "tool")}
    again = RigidChain.from_urdf(text, "flange", root_link="base", **options)
    assert_close(again(q), result.chain(q), rtol=0, atol=1e-12)
