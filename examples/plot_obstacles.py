"""
Reach through a window
======================

A trunk reaches through a window and moves to the side behind it. Its tip would fit through,
but its body would meet the frame. With ``obstacles=`` the whole body keeps clear: the chambers that
the tip does not need bend the trunk around the frame.

The body is that of a model, and no model is the robot. Here a **simulated** plant (MuJoCo) settles
at every command, and shows how far its true body was from the frame.
"""

# %%
# The window is a frame of four rods, 32 cm wide, across a trunk that is 20 cm thick. The path goes
# through it, and then around behind it. The log of 2000 rows comes with the package.

import importlib.util

import matplotlib.pyplot as plt
import numpy as np

from hybridkin import (
    HybridForwardModel,
    InverseKinematics,
    datasets,
    obstacles,
    plots,
    robots,
    trajectories,
)

CLEARANCE = 0.005  # [m]
N_TICKS = 80  # of 0.1 s
SEED = 0
corners = np.array([[-0.10, -0.16], [0.22, -0.16], [0.22, 0.16], [-0.10, 0.16]])
corners = np.column_stack([corners, np.full(4, 0.5)])
frame = []
for k in range(4):
    frame.append(obstacles.Capsule(corners[k - 1], corners[k], 0.02))

stops = np.array([[0.06, 0, 0.66], [0.06, 0, 0.75], [0.06, 0, 0.84], [0.25, 0, 0.8]])
stops = np.vstack([stops, [[0.25, 0.15, 0.78], [0.06, 0.22, 0.8]]])
lengths = np.linalg.norm(np.diff(stops, axis=0), axis=1)
along = np.append(0.0, lengths.cumsum())
places = np.linspace(0.0, along[-1], N_TICKS)
targets = np.column_stack([np.interp(places, along, column) for column in stops.T])
path = trajectories.Trajectory(0.1 * np.arange(N_TICKS), targets)

# %%
# Three models of the robot: the nominal and the calibrated constant-curvature chain, and a hybrid.
# Each one promises a distance for every command.

data = datasets.load_trunk()


def fitted(error_model, calibrate):
    """Return a model of the trunk."""
    chain = robots.bionic_handling_assistant()
    model = HybridForwardModel(
        chain, error_model, coupling="serial", calibrate=calibrate, random_state=SEED
    )
    return model.fit(data.q, data.x)


models = {
    "nominal model": robots.bionic_handling_assistant(),
    "calibrated model": fitted("drop", "default"),
    "hybrid model": fitted("quadratic", "default"),
}
settings = {"q_min": 0.19, "q_max": 0.31, "q_pref": 0.25, "dt": 0.1}


def solver(model):
    """Return inverse kinematics that keeps the body clear of the frame."""
    return InverseKinematics(
        model, obstacles=frame, clearance=CLEARANCE, body_points=16, **settings
    )


runs = {}
for name, model in models.items():
    runs[name] = (model, solver(model).track(path, tol=1e-3))
model = models["hybrid model"]
blind = InverseKinematics(model, **settings).track(path, tol=1e-3)
runs["hybrid model, without obstacles"] = (model, blind)

# %%
# The plant settles at the commands of each track. Its body is the backbone with the radius of each
# segment, every centimetre.


def settled(commands):
    """Return the backbones (T, P, 3) of the plant [m]."""
    from paper import TrunkPlant

    plant = TrunkPlant()
    bodies = []
    for q in commands:
        plant.settle(q)
        bodies.append(plant.backbone)
    return np.array(bodies)


def true_distances(bodies):
    """Return the distances (T,) of the plant's body to the frame [m]."""
    from paper.mjcf import RADII

    links = np.linspace(0.0, 18.0, 73)
    low = np.minimum(links.astype(int), 17)
    share = (links - low)[:, None]
    points = (1.0 - share) * bodies[:, low] + share * bodies[:, low + 1]
    radii = np.array(RADII)[low // 6]
    nearest = [rod.distance(points).numpy() - radii for rod in frame]
    return np.min(nearest, axis=(0, 2))


def outline(body):
    """Return circles (19, 40, 3) around a backbone, as wide as the trunk [m]."""
    from paper.mjcf import RADII

    along = np.gradient(body, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    angle = np.linspace(0.0, 2.0 * np.pi, 40)[:, None]
    radii = np.array(RADII)[(np.arange(19) - 1).clip(0) // 6][:, None, None]
    beside = np.cross(along, across)[:, None]
    rims = np.cos(angle) * across[:, None] + np.sin(angle) * beside
    return body[:, None] + radii * rims


# %%
# Without obstacles the trunk is in the frame in more than half of the ticks, and the model says so.
# With them, the calibrated and the hybrid model keep the true body clear, and the hybrid also leads
# the tip along the path. The nominal model promises as much, and collides: its body is one to two
# centimetres from the true one. A promise is worth as much as the model: the clearance must be
# larger than the error of the body. A log of tips shows the error of the tip alone; leave more.

if importlib.util.find_spec("mujoco") is None:
    print('Skipped: this example needs MuJoCo; pip install "hybridkin[sim]".')
else:
    words = f"simulated, n = {len(data.q)} rows, seed {SEED}"
    figure = plt.figure(figsize=(11, 4.4), layout="constrained")
    bodies = {name: settled(track.q) for name, (_, track) in runs.items()}
    shown = [name for name in runs if name != "calibrated model"]
    for k, name in enumerate(shown):
        ax = figure.add_subplot(1, 3, k + 1, projection="3d")
        worst = bodies[name][true_distances(bodies[name]).argmin()]
        ax.plot(*(100 * path.x.T), color="black", linewidth=1.0, label="target")
        ax.plot(*(100 * bodies[name][:, -1].T), linewidth=1.0, label="path of the tip")
        plots.BackboneDisplay(worst, disks=outline(worst)[None], obstacles=frame).plot(ax)
        ax.view_init(elev=40, azim=-70)
        ax.set_title(name, fontsize="medium")
    figure.suptitle(f"The body of the plant where it is nearest ({words})", fontsize="medium")

    figure, axes = plt.subplots(1, 4, figsize=(11, 3.6), sharey=True, layout="constrained")
    for ax, (name, (model, track)) in zip(axes, runs.items(), strict=True):
        promised = solver(model).body_distances(track.q).min(axis=1)
        true = true_distances(bodies[name])
        inside = int((true < 0.0).sum())
        error = 1e3 * np.linalg.norm(bodies[name][:, -1] - path.x, axis=1)
        print(
            f"{name}: least distance promised {1e3 * promised.min():.1f} mm, true "
            f"{1e3 * true.min():.1f} mm; {inside} of {len(true)} ticks in the frame; true tip "
            f"error {error.mean():.1f} mm"
        )
        distances = {"promised by the model": promised, "true, of the plant": true}
        display = plots.ClearanceDisplay(distances, track.t, clearance=CLEARANCE)
        display.plot(ax, unit="cm")
        ax.set_title(f"{name}\n{inside} ticks in the frame", fontsize="medium")
    for ax in axes[1:]:
        ax.set_ylabel("")
    figure.suptitle(f"Distance to the frame ({words})", fontsize="medium")
    plt.show()
