"""A night of measurements, learned by two processes
=================================================

The residual of a mechanical model, learned from more rows than fit in memory. An `ELMRegressor`
stores only means and a scatter matrix of its rows. Each process reads the chunks of its own blocks
one by one and adds them by `partial_fit`; `merge` adds the models of the blocks. The result is that
of one fit to all rows.

It needs dask (``pip install "hybridkin[dask]"``); without dask this example stops.
"""

import copy
import time

import matplotlib.pyplot as plt
import numpy as np
import torch

from hybridkin import ELMRegressor, robots

try:
    from dask.distributed import Client, LocalCluster
except ImportError:
    LocalCluster = None

# %%
# The robot moves at random all night. A camera measures its tip with 5 mm noise in each direction,
# and every chunk of the log is one file. Here a chunk is computed from its number.

NOISE = 0.005  # standard deviation [m]
BLOCKS = [range(first, first + 5) for first in range(0, 80, 5)]  # numbers of the chunks
N_ROWS = 8000  # of a chunk
NETWORK = {
    "n_hidden": 300,
    "activation": "tanh",
    "weight_scale": 0.15,
    "direct_link": True,
}
NETWORK |= {"fit_intercept": True, "random_state": 0}


def chunk(number, n_rows, noise=NOISE):
    """Return chamber lengths (n_rows, 9) and errors of the mechanical model (n_rows, 3) [m]."""
    rng = np.random.default_rng([0, number])
    q = rng.uniform(0.20, 0.25, (n_rows, 9))
    with torch.no_grad():
        x = robots.bionic_handling_assistant()(torch.from_numpy(q)).numpy()
    reach = np.linalg.norm(x[:, :2], axis=1, keepdims=True)
    sag = reach * np.hstack([0.06 * x[:, :2], -0.1 * reach])
    return q, sag + noise * rng.standard_normal((n_rows, 3))


# %%
# The tasks of the workers. All models need the same hidden layer, so the seed is an integer, and
# the same input scaling, so its bounds are given. The limits of the actuators can be the bounds;
# here a first pass finds them. `merge` changes the model on its left, and a task must not change
# its arguments, so it copies this model.


def bounds_of(numbers, n_rows):
    """Return the least and the largest inputs (2, 9) of a block [m]."""
    inputs = (chunk(number, n_rows)[0] for number in numbers)
    ends = np.array([[q.min(axis=0), q.max(axis=0)] for q in inputs])
    return np.array([ends[:, 0].min(axis=0), ends[:, 1].max(axis=0)])


def fitted(numbers, n_rows, bounds):
    """Return the model of a block."""
    model = ELMRegressor(**NETWORK, input_scaling=bounds)
    for number in numbers:
        model.partial_fit(*chunk(number, n_rows))
    return model


def merged(left, right):
    """Return the model of the rows of both."""
    return copy.deepcopy(left).merge(right)


def tip_error(model):
    """Return the root mean square error on 4000 new rows without noise [m]."""
    q, error = chunk(10**9, 4000, noise=0.0)
    return np.sqrt(np.mean(np.sum((model.predict(q) - error) ** 2, axis=1)))


# %%
# The client distributes the blocks and builds the tree. Every model of the tree is complete, so
# their errors against the number of rows give a learning curve.


def bounds_by_dask(client, blocks, n_rows):
    """Return the least and the largest inputs (2, 9) of all blocks [m]."""
    ends = np.array(client.gather(client.map(bounds_of, blocks, n_rows=n_rows, pure=False)))
    return np.array([ends[:, 0].min(axis=0), ends[:, 1].max(axis=0)])


def fit_by_dask(client, blocks, n_rows, bounds):
    """Return the model of all blocks, and (rows seen, error) of every model of the tree."""
    models = client.map(fitted, blocks, n_rows=n_rows, bounds=bounds, pure=False)
    sizes, seen, errors = [n_rows * len(block) for block in blocks], [], []
    while True:
        seen, errors = seen + sizes, errors + client.map(tip_error, models, pure=False)
        if len(models) == 1:
            return models[0].result(), np.column_stack([seen, client.gather(errors)])
        left, right, odd = slice(0, -1, 2), slice(1, None, 2), len(models) // 2 * 2
        pairs = client.map(merged, models[left], models[right], pure=False)
        models = pairs + models[odd:]
        sizes = [a + b for a, b in zip(sizes[left], sizes[right], strict=True)] + sizes[odd:]


# %%
# The same on one machine, as a loop over the same chunks.


def fit_by_loop(blocks, n_rows, bounds):
    """Return the model of all blocks, and (rows seen, error) at some points on the way."""
    model, curve = ELMRegressor(**NETWORK, input_scaling=bounds), []
    numbers = [number for block in blocks for number in block]
    for k, number in enumerate(numbers, 1):
        model.partial_fit(*chunk(number, n_rows))
        if k & (k - 1) == 0 or k == len(numbers):  # 1, 2, 4, 8, ...
            curve.append((k * n_rows, tip_error(model)))
    return model, np.array(curve)


def relative_difference(a, b):
    """Return the largest difference over the largest value."""
    return np.abs(a - b).max() / np.abs(b).max()


def compare(cluster, client, blocks=BLOCKS, n_rows=N_ROWS):
    """Return the models of tree and loop, their curves, and the times with 1 and 2 workers.

    The times (2, 3) [s] are those of the bounds, of the fit, and of the processors of all workers.
    """
    seconds = np.empty((2, 3))
    for n_workers in (1, 2):
        cluster.scale(n_workers)
        client.wait_for_workers(n_workers)
        client.run(fitted, [0], 10, [[0.2] * 9, [0.25] * 9])  # imports torch
        used = sum(client.run(time.process_time).values())
        start = time.perf_counter()
        bounds = bounds_by_dask(client, blocks, n_rows)
        between = time.perf_counter()
        model, tree = fit_by_dask(client, blocks, n_rows, bounds)
        end = time.perf_counter()
        used = sum(client.run(time.process_time).values()) - used
        seconds[n_workers - 1] = between - start, end - between, used
    looped, curve = fit_by_loop(blocks, n_rows, bounds)
    return model, looped, tree, curve, seconds


# %%
# Tree and loop agree to rounding, also part of the way. Dashed: the error of a fit without penalty
# from the noise of the camera. The penalty helps if there are few rows. The gain by the second
# worker depends on the free cores.


def draw(tree, curve, seconds):
    """Return the figure: error against rows seen, and the time of one and of two workers."""
    figure, axes = plt.subplots(
        1, 2, figsize=(9.0, 3.8), layout="constrained", width_ratios=(2.2, 1)
    )
    rows, n_features = curve[:, 0], NETWORK["n_hidden"] + 9 + 1
    law = NOISE * np.sqrt(3 * n_features / rows)
    axes[0].plot(rows, 1e3 * law, "--", color="0.6", label="noise alone, no penalty")
    axes[0].plot(rows, 1e3 * curve[:, 1], color="#0072B2", label="one machine, chunk after chunk")
    axes[0].plot(
        *(tree * [1, 1e3]).T,
        "o",
        color="#D55E00",
        alpha=0.6,
        label="models of the tree, merged",
    )
    axes[0].set(xscale="log", yscale="log", xlabel="rows seen")
    axes[0].set(ylabel="error on new rows, root mean square [mm]")
    ticks = [0.1, 0.2, 0.5, 1, 2]
    axes[0].minorticks_off()
    axes[0].set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes[0].legend(fontsize="small")
    parts = zip(seconds.T[:2], ("bounds", "fit and merge"), ("#56B4E9", "#D55E00"), strict=True)
    bottom, workers = np.zeros(2), ("1 worker", "2 workers")
    for time_taken, label, color in parts:
        axes[1].bar(workers, time_taken, 0.6, bottom, color=color, label=label)
        bottom = bottom + time_taken
    for place, total in enumerate(bottom):
        rate = f"{rows[-1] / total / (place + 1) / 1e3:.0f} thousand\nrows/s\nper worker"
        axes[1].text(place, total, rate, ha="center", va="bottom", fontsize="small")
    axes[1].set(ylabel="time [s]", ylim=(0, 1.6 * bottom.max()))
    axes[1].legend(fontsize="small", loc="upper right")
    return figure


if __name__ == "__main__":  # each worker imports this file
    if LocalCluster is None:
        print('Skipped: this example needs dask; pip install "hybridkin[dask]".')
    else:
        with (
            LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster,
            Client(cluster) as client,
        ):
            model, looped, tree, curve, seconds = compare(cluster, client)
        n_rows, n_features = curve[-1, 0], len(model.output_weights_)
        print(f"{n_rows:.0f} rows; all their features: {8e-9 * n_features * n_rows:.1f} GB")
        (q, _), start = chunk(10**9, 4000), time.perf_counter()
        merged(model, looped)
        merge_time = time.perf_counter() - start
        print("relative difference of tree and loop:")
        for what, a, b in (
            ("readout", model.output_weights_, looped.output_weights_),
            ("predictions", model.predict(q), looped.predict(q)),
        ):
            print(f"  {what}: {relative_difference(a, b):.0e}")
        for n_workers, (first, second, used) in enumerate(seconds, 1):
            rate = n_rows / (first + second) / n_workers / 1e3
            print(
                f"workers: {n_workers}; bounds {first:.1f} s, fit and merge {second:.1f} s; "
                f"{rate:.0f} thousand rows/s per worker, {n_rows / used / 1e3:.0f} thousand in a "
                "second of its processor"
            )
        print(f"one merge: {1e3 * merge_time:.0f} ms, most of it to solve for the readout")
        figure = draw(tree, curve, seconds)
        plt.show()
