"""Text files as programs write them: header blocks, decimals, encodings, counts of cells."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hybridkin import trajectories
from hybridkin.datasets import load_log, log_columns

N = 6
RNG = np.random.default_rng(0)
Q = RNG.normal(size=(N, 3)).round(3)
TIPS = RNG.normal(size=(N, 6)).round(3)  # of two markers
NAMES = {"q": ["m1", "m2", "m3"], "q_unit": "mm"}
TIP = ["tip X", "tip Y", "tip Z"]
BASE = ["base X", "base Y", "base Z"]


def lines_of(head, columns, separator=","):
    rows = [separator.join(f"{value:.10g}" for value in row) for row in np.column_stack(columns)]
    return "\n".join([*head, *rows]) + "\n"


def write(folder, text, name="log.csv", encoding="utf-8"):
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return path


def motive(units="Millimeters", rows=(), quote=""):
    """A Motive export of two markers and a rigid body, with the motors beside them."""
    objects = ["tip"] * 3 + ["base"] * 3 + ["arm"] * 8
    kinds = ["Marker"] * 6 + ["Rigid Body"] * 8
    properties = ["Position"] * 6 + ["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"]
    ids = [f"{quote}{k:04X}{quote}" for k in range(14)]
    axes = [*"XYZXYZ", *"XYZWXYZ", ""]
    settings = "Format Version,1.23,Take Name,Take 1,Capture Frame Rate,100.000000"
    head = [
        f"{settings},Rotation Type,Quaternion,Length Units,{units},Coordinate Space,Global",
        "",
        ",".join(["", "Type", *kinds, "", "", ""]),
        ",".join(["", "Name", *objects, "", "", ""]),
        ",".join(["", "ID", *ids, "", "", ""]),
        *rows,
        ",".join(["", "", *properties, "", "", ""]),
        ",".join(["Frame", "Time (Seconds)", *axes, "m1", "m2", "m3"]),
    ]
    body = np.arange(8.0 * N).reshape(N, 8)
    return lines_of(head, [np.arange(N), 0.01 * np.arange(N), TIPS, body, Q])


def vicon(unit="mm", before="", after=""):
    head = [
        "Trajectories",
        "100",
        ",,robot:tip,,,robot:base,,,,,",
        "Frame,Sub Frame,X,Y,Z,X,Y,Z,m1,m2,m3",
        f",,{','.join([unit] * 6)},,,",
    ]
    frames = np.arange(1, N + 1)
    return before + lines_of(head, [frames, 0 * frames, TIPS, Q]) + after


def qualisys(names="", leading=(), markers="tip\tbase"):
    head = [
        f"NO_OF_FRAMES\t{N}",
        "NO_OF_CAMERAS\t8",
        "NO_OF_MARKERS\t2",
        "FREQUENCY\t100",
        "NO_OF_ANALOG\t0",
        "DESCRIPTION\t--",
        "TIME_STAMP\t2024-05-03, 10:47:36.627\t94247.45402301",
        "DATA_INCLUDED\t3D",
        f"MARKER_NAMES\t{markers}",
        "TRAJECTORY_TYPES\tMeasured\tMeasured",
    ]
    if names:
        head.append(names)
    return lines_of(head, [*leading, TIPS], "\t")


# header blocks


@pytest.mark.parametrize("rows", [(), (",Parent" + "," * 15,)])
def test_an_export_of_motive(tmp_path, rows):
    path = write(tmp_path, motive(rows=rows))
    log = load_log(path, **NAMES, x=[*BASE, *TIP], x_unit="mm", time="Time (Seconds)")
    assert_allclose(log.x, 1e-3 * np.roll(TIPS, 3, axis=1))
    assert_allclose(log.q, 1e-3 * Q)
    assert_allclose(log.time, 0.01 * np.arange(N))
    assert log.line[0] == 8 + len(rows)
    names = [*log_columns(path)]
    assert names[:3] == ["Frame", "Time (Seconds)", "tip X"]
    assert names[8:16] == [
        *(f"arm rot {axis}" for axis in "XYZW"),
        *(f"arm {axis}" for axis in "XYZ"),
        "arm Mean Marker Error",
    ]


def test_markers_of_a_rigid_body_that_occur_twice_are_told_by_their_kind(tmp_path):
    text = motive().replace("Rigid Body,Rigid Body", "Rigid Body Marker,Rigid Body Marker", 1)
    text = text.replace("arm,arm,arm,arm,arm,arm,arm,arm", ",".join(["arm"] * 4 + ["tip"] * 4))
    path = write(tmp_path, text)
    assert {"Marker tip X", "Rigid Body tip X"} <= {*log_columns(path)}


@pytest.mark.parametrize("make", [motive, vicon])
def test_a_unit_that_contradicts_the_file_is_an_error(tmp_path, make):
    path = write(tmp_path, make())
    with pytest.raises(ValueError, match=r"`x_unit` must be 'mm' .* got 'm'; give x_unit='mm'"):
        load_log(path, **NAMES, x=[name for name in log_columns(path) if "tip" in name])
    path = write(tmp_path, make("Meters" if make is motive else "m"))
    with pytest.raises(ValueError, match=r"`x_unit` must be 'm' .* got 'mm'"):
        load_log(
            path, **NAMES, x=[name for name in log_columns(path) if "tip" in name], x_unit="mm"
        )


def test_an_export_of_vicon(tmp_path):
    devices = "Devices\n1000\n,,force,,\nFrame,Sub Frame,Fx,Fy,Fz\n,,N,N,N\n1,0,1,2,3\n\n"
    after = "\nModel Outputs\n100\n,,angle,,\nFrame,Sub Frame,X,Y,Z\n,,deg,deg,deg\n1,0,1,2,3\n"
    x = [f"robot:tip {axis}" for axis in "XYZ"]
    for before, end in (("", ""), (devices, ""), (devices, after), ("", after)):
        path = write(tmp_path, vicon(before=before, after=end))
        log = load_log(path, **NAMES, x=x, x_unit="mm", time="Time (Seconds)")
        assert_allclose(log.x, 1e-3 * TIPS[:, :3])
        assert_allclose(log.time, 0.01 * np.arange(1, N + 1))
        assert log.line[0] == 6 + before.count("\n")


def test_bodies_of_vicon(tmp_path):
    head = [
        "Objects",
        "100",
        ",,Global Angle (Quaternion) arm:arm,,,,,,",
        "Frame,Sub Frame,RX,RY,RZ,RW,TX,TY,TZ",
        ",,,,,,mm,mm,mm",
    ]
    frames = np.arange(N)
    path = write(tmp_path, lines_of(head, [frames, 0 * frames, np.ones((N, 4)), Q]))
    names = [*log_columns(path)]
    assert names[2:9] == [*(f"arm:arm rot {a}" for a in "XYZW"), *(f"arm:arm {a}" for a in "XYZ")]
    log = load_log(path, q=names[2:5], x=names[6:9], x_unit="mm")
    assert_allclose(log.x, 1e-3 * Q)


@pytest.mark.parametrize(
    ("names", "leading"),
    [
        ("", []),
        ("", [np.arange(N), 0.01 * np.arange(N)]),
        (
            "Frame\tTime\ttip X\ttip Y\ttip Z\tbase X\tbase Y\tbase Z",
            [np.arange(N), 0.01 * np.arange(N)],
        ),
        ("tip X\ttip Y\ttip Z\tbase X\tbase Y\tbase Z", []),
    ],
)
@pytest.mark.parametrize("ending", ["", "\t"])
def test_an_export_of_qualisys(tmp_path, names, leading, ending):
    text = qualisys(names, leading).replace("\n", f"{ending}\n")
    path = write(tmp_path, text, "log.tsv")
    time = "Time" if leading else "Time (Seconds)"
    log = load_log(path, q=BASE, x=TIP, q_unit="mm", x_unit="mm", time=time)
    assert_allclose(log.x, 1e-3 * TIPS[:, :3])
    assert_allclose(log.q, 1e-3 * TIPS[:, 3:])
    assert_allclose(log.time, 0.01 * np.arange(N))


@pytest.mark.parametrize("alone", [False, True])
def test_bodies_of_qualisys(tmp_path, alone):
    rotations = [f"Rot[{k}]" for k in range(9)]
    columns = ["X", "Y", "Z", "Roll", "Pitch", "Yaw", "Residual", *rotations]
    header = ["Frame", "Time"]
    for body in ("arm", "base"):
        header += [body, *columns] if alone else [f"{body} X", *columns[1:]]
    head = [f"NO_OF_FRAMES\t{N}", "FREQUENCY\t100", "DATA_INCLUDED\t6D", "BODY_NAMES\tarm\tbase"]
    values = np.arange(34.0 * N).reshape(N, 34)
    text = lines_of([*head, "\t".join(header)], [values], "\t")
    path = write(tmp_path, text, "log.tsv")
    names = [*log_columns(path)]
    expected = [f"{body} {name}" for body in ("arm", "base") for name in columns]
    assert names == ["Frame", "Time", *expected]
    log = load_log(path, q=["arm Roll"], x=BASE, q_unit="deg", x_unit="mm", time="Time")
    assert_allclose(log.x, 1e-3 * values[:, 18:21])


def test_a_lost_marker_is_missing(tmp_path):
    rows = qualisys().split("\n")
    rows[10] = "NULL\tNULL\tNULL\t1\t2\t3"
    rows[11] = "\t\t\t1\t2\t3"
    path = write(tmp_path, "\n".join(rows), "log.tsv")
    log = load_log(path, q=BASE, x=TIP, q_unit="mm", x_unit="mm", drop_invalid=True)
    assert log.invalid_lines.tolist() == [11, 12]


# a header that is not known


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_the_line_that_looks_like_the_header_is_named(tmp_path, separator):
    head = [
        "# Recorded by Ann, 3 May 2024",
        "",
        f"sample rate{separator}100",
        separator.join("t a b c X Y Z".split()),
    ]
    text = lines_of(head, [np.arange(N), Q, TIPS[:, :3]], separator)
    path = write(tmp_path, text)
    names = {"q": ["a", "b", "c"], "x": ["X", "Y", "Z"], "q_unit": "mm", "x_unit": "mm"}
    with pytest.raises(ValueError, match=r"line 4 looks like the header: .* header_line=4 ") as e:
        load_log(path, **names)
    assert "delimiter" not in str(e.value)
    log = load_log(path, **names, header_line=4)
    assert_allclose(log.x, 1e-3 * TIPS[:, :3])
    assert_array_equal(log.line, np.arange(5, 5 + N))
    assert [*log_columns(path, header_line=4)][:2] == ["t", "a"]


def test_a_header_line_that_is_not_there(tmp_path):
    path = write(tmp_path, vicon())
    with pytest.raises(ValueError, match=r"`header_line` must be a line of .* got 90"):
        log_columns(path, header_line=90)
    for wrong in (0, -1, True, 1.5, "2"):
        with pytest.raises(ValueError, match="`header_line` must be the number of a line"):
            log_columns(path, header_line=wrong)


def test_a_header_line_leaves_a_block_unread(tmp_path):
    path = write(tmp_path, qualisys("a\tb\tc\tX\tY\tZ"), "log.tsv")
    log = load_log(path, q=["a", "b", "c"], x=["X", "Y", "Z"], header_line=11)
    assert_allclose(log.x, TIPS[:, 3:])


# counts of cells


def plain(header="a,b,c,X,Y,Z", change=lambda rows: rows, n=N):
    rows = [",".join(f"{v:.4g}" for v in row) for row in np.arange(6.0 * n).reshape(n, 6) / 1e3]
    return "\n".join([header, *change(rows)]) + "\n"


COLUMNS = {"q": ["a", "b", "c"], "x": ["X", "Y", "Z"]}


@pytest.mark.parametrize(
    ("header", "change", "counts"),
    [
        ("a,b,c,X,Y,Z", lambda rows: [f"{k},{row}" for k, row in enumerate(rows)], (6, 2, 7)),
        ("a,b,c,X,Y,Z,", lambda rows: [f"{k},{row}" for k, row in enumerate(rows)], (6, 2, 7)),
        ("i,a,b,c,X,Y,Z", lambda rows: rows, (7, 2, 6)),
        ("a,b,c,X,Y,Z", lambda rows: [*rows[:2], rows[2] + ",5", *rows[3:]], (6, 4, 7)),
        ("a,b,c,X,Y,Z", lambda rows: [*rows[:2], "1,2", *rows[3:]], (6, 4, 2)),
        ("a,b,c,X,Y,Z", lambda rows: ["1,2", *rows], (6, 2, 2)),
    ],
)
def test_a_header_that_does_not_fit_is_refused_with_both_counts(tmp_path, header, change, counts):
    n, line, cells = counts
    path = write(tmp_path, plain(header, change))
    with pytest.raises(ValueError, match=f"names {n} columns, but line {line} has {cells} cells"):
        load_log(path, **COLUMNS)


def test_every_cut_and_every_extra_cell_is_noticed(tmp_path):
    """Random cells are deleted or added: the log is the same, or refused."""
    expected = load_log(write(tmp_path, plain()), **COLUMNS)
    rng = np.random.default_rng(1)
    for _ in range(100):
        rows = [line.split(",") for line in plain().split("\n")[:-1]]
        k = rng.integers(N)  # not the last row
        j = rng.integers(6)
        if rng.random() < 0.5:
            del rows[k][j]
        else:
            rows[k].insert(j, "0.5")
        path = write(tmp_path, "\n".join(map(",".join, rows)) + "\n")
        with pytest.raises(ValueError, match=r"names \d columns|looks like the header"):
            load_log(path, **COLUMNS)
    assert len(expected.q) == N


@pytest.mark.parametrize("end", [",", ",,", ", ,"])
def test_a_separator_at_the_end_of_lines_is_no_column(tmp_path, end):
    expected = load_log(write(tmp_path, plain()), **COLUMNS)
    for header in ("a,b,c,X,Y,Z", f"a,b,c,X,Y,Z{end}"):
        path = write(tmp_path, plain(header, lambda rows: [row + end for row in rows]))
        assert_array_equal(load_log(path, **COLUMNS).x, expected.x)
    path = write(tmp_path, plain(f"a,b,c,X,Y,Z{end}"))
    assert_array_equal(load_log(path, **COLUMNS).x, expected.x)


def test_a_row_that_was_cut_off_at_the_end_is_missing(tmp_path):
    path = write(tmp_path, plain(change=lambda rows: [*rows[:-1], rows[-1][:12]]))
    with pytest.raises(ValueError, match=rf"1 of {N} rows .* \(line {N + 1}\)"):
        load_log(path, **COLUMNS)
    log = load_log(path, **COLUMNS, drop_invalid=True)
    assert len(log.q) == N - 1


# decimals and encodings


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas(tmp_path, separator):
    text = plain().replace(",", separator).replace(".", ",")
    path = write(tmp_path, text)
    with pytest.raises(ValueError, match=r"got '0,\d+'; .* give decimal=\",\" \(--decimal ,\)"):
        load_log(path, **COLUMNS)
    log = load_log(path, **COLUMNS, decimal=",")
    assert_array_equal(log.x, load_log(write(tmp_path, plain()), **COLUMNS).x)


def test_points_where_commas_are_declared(tmp_path):
    path = write(tmp_path, plain().replace(",", ";"))
    with pytest.raises(ValueError, match="its decimals have a point: leave out decimal"):
        load_log(path, **COLUMNS, decimal=",")
    path = write(tmp_path, plain().replace(",", ";").replace("0.001", "1.000,5").replace(".", ","))
    with pytest.raises(ValueError, match="a number is needed, got '1,000,5'"):
        load_log(path, **COLUMNS, decimal=",")
    with pytest.raises(ValueError, match=r"`decimal` must be \".\" or \",\""):
        load_log(path, **COLUMNS, decimal=";")


def test_commas_for_decimals_and_columns_are_refused(tmp_path):
    path = write(tmp_path, "a,b,c,X,Y,Z\n" + "1,5,1,5,1,5,1,5,1,5,1,5\n" * 3)
    with pytest.raises(ValueError, match=r"names 6 columns, but line 2 has 12 cells; if decimals"):
        load_log(path, **COLUMNS)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1", "cp1252"])
def test_encodings(tmp_path, encoding):
    names = ["angle [°]", "b (µm)", "c"]
    path = write(tmp_path, plain("angle [°],b (µm),c,X,Y,Z"), encoding=encoding)
    log = load_log(path, names, COLUMNS["x"])
    assert log.q_names == names
    assert_array_equal(log.x, load_log(write(tmp_path, plain()), **COLUMNS).x)


def test_binary_files_are_no_text(tmp_path):
    rng = np.random.default_rng(2)
    for _ in range(20):
        path = tmp_path / "log.csv"
        path.write_bytes(rng.bytes(500))
        with pytest.raises(ValueError, match="is not a text file"):
            load_log(path, **COLUMNS)


# paths


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("header", ["", "t,x,y,z\n", "# points\nt,x,y,z\n"])
@pytest.mark.parametrize("end", ["", ","])
def test_paths_have_any_separator(tmp_path, separator, header, end):
    points = np.column_stack([np.arange(N) / 8, TIPS[:, :3]])
    rows = "".join(",".join(f"{v:.6g}" for v in row) + end + "\n" for row in points)
    path = write(tmp_path, (header + rows).replace(",", separator))
    assert_allclose(trajectories.from_csv(path).x, TIPS[:, :3])
    if separator != ",":
        path = write(tmp_path, (header + rows).replace(",", separator).replace(".", ","))
        assert_allclose(trajectories.from_csv(path).x, TIPS[:, :3])


# small things


@pytest.mark.parametrize("row", ["mm,mm,mm,cm,cm,cm", "[mm],[mm],[mm],[cm],[cm],[cm]"])
def test_a_row_of_units_is_read(tmp_path, row):
    path = write(tmp_path, plain(change=lambda rows: [row, *rows]))
    log = load_log(path, **COLUMNS, q_unit="mm", x_unit="cm")
    assert_allclose(log.x, 0.01 * load_log(write(tmp_path, plain()), **COLUMNS).x)
    path = write(tmp_path, plain(change=lambda rows: [row, *rows]))
    with pytest.raises(ValueError, match="`x_unit` must be 'cm' for column 'X', as line 2"):
        load_log(path, **COLUMNS, q_unit="mm", x_unit="mm")


def test_a_row_of_words_is_no_row_of_units(tmp_path):
    path = write(tmp_path, plain(change=lambda rows: ["u,v,w,x,y,z", *rows]))
    with pytest.raises(ValueError, match=r"Line 2 .* a number is needed, got 'u'"):
        load_log(path, **COLUMNS)


@pytest.mark.parametrize("separator", [" ", "  ", "\t", ","])
@pytest.mark.parametrize("comments", ["# ", "#", ""])
def test_tables_as_numpy_saves_them(tmp_path, separator, comments):
    values = np.arange(6.0 * N).reshape(N, 6) / 1e3
    header = separator.join(["a", "b", "c", "X", "Y", "Z"])
    path = tmp_path / "log.txt"
    np.savetxt(path, values, delimiter=separator, header=header, comments=comments)
    log = load_log(path, **COLUMNS)
    assert_allclose(np.hstack([log.q, log.x]), values)
    if comments:
        assert_allclose(load_log(path, ["# a", "b"], COLUMNS["x"]).q, values[:, :2])
