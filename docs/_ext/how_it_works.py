"""Draw docs/images/how_it_works.png: the models, and the folders in the direction of imports.

Run ``python docs/_ext/how_it_works.py`` after a change of either.
"""

from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
from matplotlib.patches import FancyBboxPatch

BLUE, ORANGE, GREEN, GREY = "#cfe5f5", "#f9dcc0", "#cdebdf", "#eeeeee"
MODELS = {  # x, y, width, colour, text
    "log": (0.2, 4.55, 2.1, GREY, "log\nactuators q, tips x"),
    "calibrate": (3.0, 4.55, 2.3, ORANGE, "calibrate\nfits the geometry"),
    "fit": (6.0, 4.55, 2.5, ORANGE, "HybridForwardModel\nfits the residual"),
    "chain": (3.0, 3.0, 2.3, BLUE, "chain\nq → tip"),
    "hybrid": (6.0, 3.0, 2.5, BLUE, "hybrid module\nchain + correction"),
    "ik": (9.2, 3.0, 2.4, GREEN, "InverseKinematics\npath → commands q"),
    "saving": (9.2, 4.55, 2.4, GREEN, "save_model\none file, no code"),
    "native": (9.2, 1.45, 2.4, GREEN, "native\nkernels in C, export"),
    "interface": (0.2, 3.0, 2.1, BLUE, "ForwardModel\nthe one interface"),
}
ARROWS = (
    *(
        ("log", "calibrate"),
        ("calibrate", "fit"),
        ("calibrate", "chain"),
        ("fit", "hybrid"),
    ),
    *(
        ("chain", "hybrid"),
        ("hybrid", "ik"),
        ("hybrid", "saving"),
        ("hybrid", "native"),
    ),
)
FOLDERS = (  # in one direction: each column imports from those left of it
    ("_core",),
    ("native",),
    ("chains", "learning", "ik"),
    ("calibration",),
    ("hysteresis",),
    ("hybrid",),
    ("saving",),
    ("app",),
)
BESIDE = ("datasets", "plots")  # they import from _core; plots from chains, too
TOOLS = ("arguments", "formats", "rotations")  # public modules of what is inside
APP = ("checks", "workflow", "viewer", "cli")  # each imports from those before it


def box(ax, x, y, width, color, text, height=0.95):
    """Draw a box with its lower left corner at (x, y)."""
    style = "round,pad=0,rounding_size=0.12"
    ax.add_patch(FancyBboxPatch((x, y), width, height, style, fc=color, ec="0.35", lw=1.0))
    ax.text(x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=9.5)


def arrow(ax, start, end, **looks):
    """Draw an arrow from one point to another."""
    look = {"arrowstyle": "-|>", "color": "0.35", "lw": 1.2, **looks}
    ax.annotate("", xy=end, xytext=start, arrowprops=look)


def draw_models(ax):
    """Draw what is made of a log, and the three users of a model."""
    ax.set_title("From a log to commands", loc="left", fontsize=12)
    for x, y, width, color, text in MODELS.values():
        box(ax, x, y, width, color, text)
    for a, b in ARROWS:
        (xa, ya, wa, *_), (xb, yb, _, *_) = MODELS[a], MODELS[b]
        if xa == xb:
            arrow(ax, (xa + wa / 2, ya), (xb + wa / 2, yb + 0.95))
        else:
            arrow(ax, (xa + wa, ya + 0.475), (xb, yb + 0.475))
    ax.plot([2.3, 3.0], [3.475, 3.475], color="0.35", lw=1.0, ls=":")
    ax.text(0.2, 2.05, "blue: models q → x, all of them a ForwardModel", fontsize=9.5)
    use = "orange: fits; green: what uses a model, through ForwardModel alone"
    ax.text(0.2, 1.65, use, fontsize=9.5)
    ax.set(xlim=(0.0, 11.8), ylim=(1.2, 5.7))


def draw_folders(ax):
    """Draw the folders of the package; imports point to the left."""
    title = "The folders; a folder imports only from those left of it"
    ax.set_title(title, loc="left", fontsize=12)
    width, step = 1.18, 1.46
    for k, names in enumerate(FOLDERS):
        middle = 2.9 - 0.35 * len(names)
        for i, name in enumerate(reversed(names)):
            box(ax, 0.1 + step * k, middle + 0.7 * i, width, BLUE, name, 0.58)
        if k:
            arrow(ax, (0.1 + step * k, 2.85), (0.1 + step * (k - 1) + width, 2.85))
    rows = (
        (BESIDE, GREY, "use _core alone (plots: chains, too)"),
        (TOOLS, GREY, "public modules for tools such as app"),
        (APP, GREEN, "within app; each imports from those left of it"),
    )
    for row, (names, color, text) in enumerate(rows):
        low = 1.25 - 0.7 * row
        for k, name in enumerate(names):
            box(ax, 0.1 + step * k, low, width, color, name, 0.58)
        ax.text(0.1 + step * len(names), low + 0.29, text, va="center", fontsize=9.5)
    ax.set(xlim=(0.0, 11.8), ylim=(-0.25, 4.0))


def main():
    """Write the picture."""
    figure, (top, bottom) = plt.subplots(
        2, 1, figsize=(10.0, 7.8), height_ratios=(4.5, 4.25), layout="constrained"
    )
    draw_models(top)
    draw_folders(bottom)
    for ax in (top, bottom):
        ax.set_axis_off()
    path = Path(__file__).parents[1] / "images" / "how_it_works.png"
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main()
