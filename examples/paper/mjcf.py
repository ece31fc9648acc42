"""The MuJoCo model (MJCF) of the simulated trunk."""

import numpy as np

RADII = (0.100, 0.093, 0.079)  # hull radius per segment [m]
REST_LENGTH = 0.25  # rest length of every chamber [m]
LINKS = 6  # per segment
TIME_STEP = 0.0025  # [s]
RELAXATION = 0.2  # damping / stiffness of every joint [s]


def trunk_mjcf(
    gravity: tuple[float, float],
    mass: float,
    tip_mass: float,
    stiffness: tuple[float, ...],
) -> str:
    """Return the MJCF of a trunk along z, with sites and tendons for its nine chambers.

    A link extends, bends about two axes, twists and extends. Half of the extension lies on each
    side of the bends, and the order of the two bends alternates. The model therefore prefers no
    direction, neither along the trunk nor about it.

    Parameters
    ----------
    gravity : tuple of two floats
        Gravitational acceleration along x and z [m/s^2].
    mass : float
        Mass of the three segments together [kg].
    tip_mass : float
        Mass at the tip [kg].
    stiffness : tuple of three floats
        Bending and torsional [N m^2] and axial [N] stiffness of the first segment.

    Returns
    -------
    xml : str
        The model. Its tendons and motors are the chambers in the order of q; its site "tip" is the
        tip.
    """
    share = np.square(RADII) / RADII[0] ** 2
    height = REST_LENGTH / LINKS
    psi = 2 * np.pi / 3 * np.arange(3)

    def ring(segment, level):
        x, y = RADII[segment] * np.cos(psi), RADII[segment] * np.sin(psi)
        return "".join(
            f'<site name="s{segment}_{i}_{level}" pos="{x[i]:.17g} {y[i]:.17g} 0"/>'
            for i in range(3)
        )

    def joint(kind, axis, value, armature, z=0.0):
        return (
            f'<joint type="{kind}" axis="{axis}" pos="0 0 {z:.17g}" stiffness="{value:.17g}" '
            f'damping="{RELAXATION * value:.17g}" armature="{armature}"/>'
        )

    bodies = [ring(0, 0)]
    for s in range(3):
        bend, twist, stretch = (value * share[s] / height for value in stiffness)
        slide = joint("slide", "0 0 1", 2 * stretch, 0.01)  # each of two in series
        link_mass = mass * share[s] / share.sum() / LINKS
        for k in range(LINKS):
            axes = ("1 0 0", "0 1 0") if k % 2 == 0 else ("0 1 0", "1 0 0")
            bodies += [
                f'<body pos="0 0 {height:.17g}">',
                slide,
                *(joint("hinge", axis, bend, 0.001, -height / 2) for axis in axes),
                joint("hinge", "0 0 1", twist, 0.001),
                slide,
                f'<geom type="cylinder" size="{RADII[s]} {height / 2:.17g}" '
                f'pos="0 0 {-height / 2:.17g}" mass="{link_mass:.17g}"/>',
                ring(s, k + 1),
            ]
        if s < 2:
            bodies.append(ring(s + 1, 0))
    if tip_mass:
        bodies.append(f'<geom type="sphere" size="0.03" mass="{tip_mass:.17g}"/>')
    bodies.append('<site name="tip"/>')
    tendons = [
        f'<spatial name="chamber{3 * s + i}">'
        + "".join(f'<site site="s{s}_{i}_{k}"/>' for k in range(LINKS + 1))
        + "</spatial>"
        for s in range(3)
        for i in range(3)
    ]
    motors = "".join(f'<motor tendon="chamber{i}"/>' for i in range(9))
    return (
        f'<mujoco><option gravity="{gravity[0]:.17g} 0 {gravity[1]:.17g}" '
        f'timestep="{TIME_STEP}" integrator="implicitfast">'
        '<flag contact="disable" constraint="disable"/></option>'
        f"<worldbody>{''.join(bodies)}{'</body>' * (3 * LINKS)}</worldbody>"
        f"<tendon>{''.join(tendons)}</tendon><actuator>{motors}</actuator></mujoco>"
    )
