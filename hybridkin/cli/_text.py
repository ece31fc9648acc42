"""What the commands say: records in, lines of text out."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

_WORST = 15  # motions shown


def paper(record: dict[str, Any]) -> Iterator[str]:
    """Yield what `paper` found."""
    yield "Test error on the simulated trunk, mean ± std (max) [cm]"
    for entry in record["table1"]:
        test = {key: 100 * value for key, value in entry["test"].items()}
        name = f"{entry['model']}, {entry['learner']}".removesuffix(", -")
        yield f"  {name:34s} {test['mean']:6.2f} ± {test['std']:.2f} ({test['max']:.1f})"
    yield "Tracking error on the simulated trunk, both paths, mean [cm]"
    for name, stats in record["tracking"]["both"].items():
        yield f"  {name:34s} {100 * stats['mean']:6.2f}"
    found = record["identifiability"]
    yield (
        f"What {found['n_single']} rows of one segment and {found['n_random']} random rows of the "
        "simulated trunk tell about its geometry"
    )
    yield "  parameter                 calibrated  std. error   prior narrowed"
    for entry in found["asked"]["entries"]:
        name = f"{entry['name']} [{entry['unit']}]"
        yield (
            f"  {name:24s} {entry['value']:11.2f} {entry['std_error']:11.2f} "
            f"{entry['narrowing']:10.3g} x  {'told' if entry['told'] else 'not told'}"
        )
    yield "  They leave open:"
    for sentence in found["asked"]["unidentified"]:
        yield textwrap.fill(sentence, 96, initial_indent="  - ", subsequent_indent="    ")


def fit(record: dict[str, Any]) -> Iterator[str]:
    """Yield what `fit` found."""
    rows = [
        [name, *(f"{1000 * stats[key]:.2f}" for key in ("mean", "p95", "max"))]
        for name, stats in record["held_out"].items()
    ]
    yield from table(["tip error on motions held out [mm]", "mean", "95 %", "max"], rows)
    yield from _filled("Saved: ", f"{record['saved']}, fitted to all motions: {record['chosen']}")
    for sentence in record.get("auto", {}).get("words", ()):
        yield from _filled("  ", sentence)


def evaluate(record: dict[str, Any]) -> Iterator[str]:
    """Yield the errors of all rows and of the worst motions."""
    shares = [key for key in record["all"] if key.startswith("share")]
    header = ["tip error [mm]", "rows", "mean", "median", "95 %", "max"]
    header += [key.replace("share_", "").replace("_", " ") for key in shares]
    ranked = sorted(record["motions"].items(), key=lambda item: -item[1]["mean"])
    rows = []
    for name, entry in [("all rows", record["all"]), *ranked[:_WORST]]:
        cells = [f"{1000 * entry[key]:.2f}" for key in ("mean", "median", "p95", "max")]
        cells += [f"{100 * entry[key]:.0f} %" for key in shares]
        rows.append([name, str(entry["rows"]), *cells])
    yield from table(header, rows)
    if len(ranked) > _WORST:
        yield f"and {len(ranked) - _WORST} motions with smaller errors"
    if "coverage_asked" in record:
        asked = 100 * record["coverage_asked"]
        yield f"The radius was made for {asked:.0f} % of the tips of new motions"


def track(record: dict[str, Any]) -> Iterator[str]:
    """Yield how a path was followed."""
    errors = {key: 1000 * value for key, value in record["errors"].items()}
    yield (
        f"{record['reached']} of {record['n']} points reached to within "
        f"{1000 * record['tol']:g} mm, by the model"
    )
    yield (
        f"  error [mm]   mean {errors['mean']:.3g}, 95 % {errors['p95']:.3g}, max "
        f"{errors['max']:.3g}"
    )
    counts = ", ".join(f"{n} {name}" for name, n in record["statuses"].items())
    yield f"  status       {counts}"
    yield f"  limits       {record['limits']['source']}"
    if record["in_domain"] is not None:
        share = 100 * record["in_domain"]
        yield f"  domain       {share:.0f} % of the points where the learned part is trusted"
    if record["play"] is not None:
        yield (
            f"  play         {1e3 * max(record['play']):.3g} mm; a command jumps by that where its "
            "actuator turns back"
        )
    columns = record["columns"]
    sign = ", shortening positive" if columns["q_sign"] < 0 else ""
    yield (
        f"  track.csv    q in {columns['q_unit']}{sign}, x, target and error in "
        f"{columns['x_unit']}, t in s"
    )
    if record["play"] is not None:
        yield "               q is what to send, effective_... what the actuators do"


def animate(record: dict[str, Any]) -> Iterator[str]:
    """Yield what was filmed."""
    yield f"{record['frames']} frames, {record['fps']:.3g} a second, {record['bytes'] / 1e6:.2f} MB"


def benchmark(record: dict[str, Any]) -> Iterator[str]:
    """Yield the times of every kind of work."""
    rows = []
    for entry in record["entries"]:
        per_row = entry["seconds_per_row"]
        rows.append(
            [entry["what"], f"{entry['rows']}", f"{1e6 * per_row:.3g}", f"{1 / per_row:.3g}"]
        )
    yield from table([f"{record['model']}", "rows at once", "µs per row", "rows per s"], rows)
    versions = ", ".join(f"{name} {value}" for name, value in record["versions"].items())
    yield f"{record['threads']} threads of {record['cores']} cores, {record['processor']}"
    yield versions


def describe(record: dict[str, Any]) -> Iterator[str]:
    """Yield what is known of a model."""
    yield f"{record['name']}: {record['kind']}, {record['n_actuators']} actuators"
    yield from _geometry(record["geometry"])
    error = record["error_model"]
    if error is not None:
        parts = [error["kind"], error["coupling"], f"guard {error['guard'] or 'none'}"]
        yield from _filled("  error model: ", ", ".join(part for part in parts if part))
    if record["radius"] is not None:
        radius = record["radius"]
        yield (
            f"  radius for {100 * radius['coverage']:.0f} % of the tips: "
            f"{1e3 * radius['inside']:.3g} mm inside the domain, {1e3 * radius['outside']:.3g} mm "
            "outside"
        )
    if record["play"] is not None:
        yield f"  play of the actuators: {1e3 * max(record['play']):.3g} mm"
    if record["domain"] is not None:
        low, high = record["domain"]["q_min"], record["domain"]["q_max"]
        spans = ", ".join(f"{1e3 * a:.3g} to {1e3 * b:.3g}" for a, b in zip(low, high, strict=True))
        yield from _filled("  fitted for q [mm]: ", spans)
    if record["limits"] is not None and any(record["limits"].values()):
        for name, value in record["limits"].items():
            if value is not None:
                yield from _filled(f"  {name} [mm]: ", ", ".join(f"{1e3 * v:.3g}" for v in value))
    if record["log_format"] is not None:
        log = record["log_format"]
        yield from _filled(
            "  logs: ",
            f"q in {log['q_unit']}, q_sign {log['q_sign']} ({', '.join(log['q'])}), x in "
            f"{log['x_unit']} ({', '.join(log['x'])})",
        )
    yield from _training(record["training"] or {})
    if record["auto"] is not None:
        for sentence in record["auto"]["words"]:
            yield from _filled("  ", sentence)
    if record["versions"] is not None:
        versions = ", ".join(f"{name} {value}" for name, value in record["versions"].items())
        yield from _filled(f"  saved on {record['created']} by ", versions)


def _training(training: dict[str, Any]) -> Iterator[str]:
    """Yield what the file says of the fit; of one that was saved by hand it may be little."""
    if "log" in training:
        thinned = "" if training["n_whole"] == training["rows"] else f" of {training['n_whole']}"
        yield (
            f"  fitted to {training['log']}: {training['rows']}{thinned} rows, "
            f"{training['n_motions']} motions"
        )
        yield from _filled("  taken: ", f"{training['saved']}, {training['chosen']}")
        rows = [
            [name, *(f"{1e3 * entry[key]:.2f}" for key in ("mean", "p95", "max"))]
            for name, entry in training["held_out"].items()
        ]
        yield from table(["tip error on motions held out [mm]", "mean", "95 %", "max"], rows)
    elif "rows" in training:
        yield f"  fitted to {training['rows']} rows"


def _geometry(geometry: dict[str, Any] | None) -> Iterator[str]:
    if geometry is None:
        yield "  no mechanical model"
        return
    yield f"  {geometry['kind']}" + (
        f", routing {geometry['routing']}" if "routing" in geometry else ""
    )
    rows = []
    for k, entry in enumerate(geometry.get("segments", [])):
        length = "extensible" if entry["length"] is None else f"{1e3 * entry['length']:.2f}"
        angles = ", ".join(f"{angle:.1f}" for angle in entry["angles_deg"])
        rows.append(
            [
                f"{k + 1}",
                f"{1e3 * entry['radius']:.3f}",
                length,
                f"{1e3 * entry['offset']:.2f}",
                angles,
            ]
        )
    if rows:
        yield from table(
            ["segment", "radius [mm]", "length [mm]", "offset [mm]", "actuators at [deg]"], rows
        )
    if geometry["base"] is not None:
        position = ", ".join(f"{1e3 * v:.2f}" for v in geometry["base"]["position"])
        turn = ", ".join(f"{v:.1f}" for v in geometry["base"]["rotation_vector_deg"])
        yield f"  base at ({position}) mm, turned by ({turn}) deg"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield lines of columns, the first to the left, the others to the right."""
    widths = [max(len(line[i]) for line in (header, *rows)) for i in range(len(header))]
    for line in (header, *rows):
        cells = [f"{cell:>{width}s}" for cell, width in zip(line[1:], widths[1:], strict=True)]
        yield f"  {line[0]:{widths[0]}s}  " + "  ".join(cells)


def _filled(head: str, text: str) -> list[str]:
    return textwrap.wrap(
        text, 96, initial_indent=head, subsequent_indent=" " * len(head), break_on_hyphens=False
    )
