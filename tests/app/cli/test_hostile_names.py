"""Commands with a robot whose every name is hostile: what they write and print stays text."""

import csv
import json
import re
import shutil
import subprocess
import zipfile
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from markdown_it import MarkdownIt

import hybridkin
from hybridkin import robots
from hybridkin.app.cli.main import main

SPLICE = "c*\\\n/ __attribute__((constructor)) static void evil(void){} /*\\\n*"
TRIGRAPH = "*??/\n/ static void evil(void){} /*??/\n*"
TERMINAL = "\x1b]0;owned\x07\x1b[2J\u202eb\u2028\x9b1A\x7f"
WEB = "<img src=x onerror=alert(1)> [a](https://evil.xyz) ![b](https://evil.xyz/b) www.evil.xyz"
FORMULA = "=cmd|' /C calc'!A0;;;;;;;;;;;;"
MATHS = "$\\frac{$_{alert(1)}"
NAMES = (SPLICE, TRIGRAPH + TERMINAL, FORMULA)
TIPS = (WEB, "@SUM(1)", MATHS)
UNIT = f"Pa{TERMINAL}*/ {WEB} $\\frac{{$"
MOTIONS = (f"- {WEB}|", f"m\u202e{TERMINAL}", "m`|`<b>", "\n# heading")


def text(value):
    """Return a text in TOML."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


ROBOT = f"""name = {text(WEB + TERMINAL)}
calibrate = []
[[segment]]
radius = 0.005
length = 0.1
gain = 0.001
[log]
q = [{", ".join(map(text, NAMES))}]
x = [{", ".join(map(text, TIPS))}]
q_unit = {text(UNIT)}
groups = {text("=motion" + TERMINAL)}
[limits]
q_min = -6
q_max = 6
unit = "log"
"""
SHAPE = "--shape line --size 0.001,0.001,0 --unit m --duration 1 --dt 0.1".split()
FAST = ["--folds", "2", "--no-auto", "--jobs", "1"]
LOG = f"{TERMINAL}{WEB.replace('/', ' ')}*\\\n.csv"
COMMANDS = {
    "describe": ["describe", "robot.toml"],
    "check": ["describe", LOG, "--robot", "robot.toml"],
    "evaluate": ["evaluate", "robot.toml", LOG, "--out", "out"],
    "track": ["track", "robot.toml", *SHAPE, "--out", "out"],
    "next": ["next", "robot.toml", "-n", "3", "--out", "out"],
    "export": ["export", "robot.toml", "--out", "out", "--dt", "0.01"],
    "mex": ["export", "robot.toml", "--mex", "--out", "out"],
    "fmu": ["export", "robot.toml", "--fmu", "out.fmu"],
    "wrong column": ["evaluate", "robot.toml", LOG, "--q", TERMINAL],
    "no file": ["evaluate", "robot.toml", TERMINAL],
    "unknown": ["describe", "robot.toml", f"--{TERMINAL}"],
    "fit": ["fit", LOG, "--robot", "data.toml", "--out", "out", *FAST],
}
SLOW = ("fit", "fmu", "evaluate", "track", "next")


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A folder with a robot and a log, in which commands run."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.toml").write_text(ROBOT, encoding="utf-8")
    data = ROBOT[: ROBOT.index("calibrate")] + ROBOT[ROBOT.index("[log]") :]
    data = data[: data.index("[limits]")].replace(text(UNIT), '"mm"')
    (tmp_path / "data.toml").write_text(data, encoding="utf-8")
    turns = np.linspace(0, 6, 20)[:, None] + np.arange(3)
    q = np.concatenate([4.0 * size * np.sin(turns) for size in (1.0, 0.8, 0.6, 0.5)])
    x = robots.read_description(tmp_path / "robot.toml").chain(torch.from_numpy(q)).numpy()
    x += 2e-4 * np.sin(0.3 * q)
    with open(LOG, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*NAMES, *TIPS, "=motion" + TERMINAL])
        for k, row in enumerate(np.hstack([q, x])):
            writer.writerow([*map(repr, map(float, row)), MOTIONS[k // 20]])
    return tmp_path


def hidden(written):
    return [c for c in written if not (c.isprintable() or c in "\n\u200c\u200d")]


def kinds(written):
    """Return the kinds of tokens that Markdown reads, and the HTML among them."""
    found = set()
    for block in MarkdownIt("commonmark").enable("table").parse(written):
        found |= {token.type for token in [block, *(block.children or [])]}
    return found


def check_printed(printed):
    for stream in printed:
        assert not hidden(stream), hidden(stream)


def check_c(folder, name="model"):
    source = folder / f"{name}.c"
    for options in (["-std=c99"], ["-std=gnu11"], ["-std=gnu11", "-trigraphs"]):
        command = ["cc", "-E", *options, str(source)]
        tokens = subprocess.check_output(command, text=True)
        assert "evil" not in tokens
        assert tokens.count("model_forward") == 2


@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=pytest.mark.slow if k in SLOW else ()) for k in COMMANDS]
)
@pytest.mark.filterwarnings("ignore:Glyph", "ignore:constrained_layout")
def test_what_a_command_writes_and_prints_is_text(home, capsys, kind):
    if kind in ("export", "fmu") and not shutil.which("cc"):
        pytest.skip("needs a C compiler")
    capsys.readouterr()
    try:
        code = main([*COMMANDS[kind]])
    except SystemExit as error:
        code = error.code
    wanted = 2 if kind in ("wrong column", "no file", "unknown") else 0
    printed = capsys.readouterr()
    assert code == wanted, printed.err
    check_printed(printed)
    out = home / "out"
    for path in out.glob("*"):
        if path.suffix in (".md", ".csv", ".c", ".h", ".m", ".json", ".txt"):
            assert not hidden(path.read_text(encoding="utf-8")), path.name
    for path in out.glob("*.md"):
        found = kinds(path.read_text(encoding="utf-8"))
        assert not found & {"html_inline", "html_block", "link_open"}
        assert "image" not in found or list(out.glob("*.png"))
    for path in out.glob("*.csv"):
        (header, *_) = csv.reader(path.read_text(encoding="utf-8").splitlines())
        assert not [cell for cell in header if re.match(r"[=+\-@\s]", cell)]
    if kind == "track":
        read = hybridkin.datasets.load_log(out / "track.csv", NAMES, TIPS)
        assert (*read.q_names, *read.x_names) == (*NAMES, *TIPS)
    if kind == "export":
        check_c(out)
    if kind == "mex":
        assert "<a" not in (out / "model.m").read_text()
        lines = (out / "model.m").read_text().splitlines()
        assert {line[0] for line in lines[:-1]} == {"%"}
    if kind == "fmu":
        check_unit(home)


def check_unit(home):
    with zipfile.ZipFile(home / "out.fmu") as archive:
        root = ElementTree.fromstring(archive.read("modelDescription.xml"))
        archive.extractall(home / "out")
    _, _, about_q = root.get("description").partition(". ")
    assert root.find(".//Float64[@name='q']").get("description") == about_q
    check_c(home / "out" / "sources")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Glyph", "ignore:constrained_layout")
def test_a_film_shows_names_as_text(home, capsys):
    pytest.importorskip("viser", reason='needs viser: pip install "hybridkin[view]"')
    for film in ("film.gif", "film.html"):
        assert main(["animate", "robot.toml", LOG, "--out", film, "--frames", "2"]) == 0
    check_printed(capsys.readouterr())


def test_a_description_from_hostile_names_reads_back(home, capsys):
    options = ["--kind", "tendons", "--segments", "1", "--radius", "5", "--length", "100"]
    options += ["--q-unit", UNIT, "--gain", "1", "--log", LOG, "--x-unit", "m", "--q-sign", "1"]
    q = [name.replace(",", "") for name in NAMES]
    with open(LOG, encoding="utf-8", newline="") as file:
        rows = [*csv.reader(file)]
    assert rows[0][:3] == q
    options += [f"--q={','.join(q)}", f"--x={','.join(TIPS)}", "--groups", rows[0][-1]]
    code = main(["init", "new.toml", *options])
    printed = capsys.readouterr()
    assert code == 0, printed.err
    check_printed(printed)
    assert not hidden((home / "new.toml").read_text(encoding="utf-8"))
    log = robots.read_description(home / "new.toml").log
    assert (*log.q, *log.x, log.q_unit) == (*q, *TIPS, UNIT)


class Tags(HTMLParser):
    def __init__(self):
        super().__init__()
        self.found = set()

    def handle_starttag(self, tag, attrs):
        self.found.add(tag)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*pull the tendons")
def test_columns_of_a_table_are_text_in_a_notebook():
    pd = pytest.importorskip("pandas", reason="needs pandas")
    rng = np.random.default_rng(0)
    frame = pd.DataFrame(rng.uniform(-0.005, 0.005, (40, 3)), columns=[*NAMES[:2], WEB])
    chain = hybridkin.ConstantCurvatureChain([0.005], lengths=[0.1])
    model = hybridkin.HybridForwardModel(chain, "linear", calibrate=None, random_state=0)
    model.fit(frame, chain(torch.tensor(frame.to_numpy())).numpy())
    html = model._repr_html_()
    reader = Tags()
    reader.feed(html)
    assert "img" not in reader.found
    assert not hidden(html)
