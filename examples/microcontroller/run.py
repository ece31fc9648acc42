"""Six kinds of models in single precision on a Cortex-M4F and a Cortex-M7, under qemu.

Prints a table: largest difference from the desktop, flash, RAM and stack. Needs
arm-none-eabi-gcc with newlib, qemu-system-arm, and the system's C compiler.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    ELMRegressor,
    HybridForwardModel,
    InverseKinematics,
    datasets,
    native,
    robots,
)

HERE = Path(__file__).parent
CORES = {
    "cortex-m4": ("mps2-an386", "-mfpu=fpv4-sp-d16"),
    "cortex-m7": ("mps2-an500", "-mfpu=fpv5-sp-d16"),
}
ROWS, STEPS = 5, 40
HEAP = {"malloc", "_malloc_r", "free", "_sbrk", "sbrk", "calloc", "realloc"}


def models():
    """Return models and controllers by name, small fits of simulated rows."""
    trunk = robots.bionic_handling_assistant()
    data = datasets.load_trunk()
    rows = datasets.paper_split(data, random_state=0)[0][:400]
    limits = {"q_min": 0.1, "q_max": 0.4, "q_pref": 0.25, "dt": 0.01}
    elm = HybridForwardModel(trunk, ELMRegressor(50, random_state=0), random_state=0)
    serial = HybridForwardModel(trunk, "quadratic", coupling="serial", random_state=0)
    tendons = ConstantCurvatureChain([0.005, 0.005], lengths=[0.06, 0.06], routing="base")
    elastic = ElasticTendonChain([0.005, 0.005], [0.06, 0.06], bending_stiffness=3e-7)
    return {
        "trunk of chambers": InverseKinematics(trunk, **limits),
        "the same, model alone": trunk,
        "tendons": InverseKinematics(tendons, q_min=-0.004, q_max=0.004, dt=0.01),
        "elastic tendons": InverseKinematics(elastic, q_min=-0.004, q_max=0.004, dt=0.01),
        "hybrid, network of 50": InverseKinematics(elm.fit(data.q[rows], data.x[rows]), **limits),
        "hybrid, serial quadratic": InverseKinematics(
            serial.fit(data.q[rows], data.x[rows]), **limits
        ),
    }


def built(folder, core):
    """Compile for a core and return the program."""
    _, unit = CORES[core]
    flags = f"-mcpu={core} -mthumb -mfloat-abi=hard {unit} -std=gnu99 -O2 -fno-math-errno".split()
    flags += [
        "-ffp-contract=fast",
        "-fstack-usage",
        "-ffunction-sections",
        "-Wall",
    ]
    flags += definitions(folder)
    program = folder / f"{core}.elf"
    sources = [folder / "model.c", HERE / "main.c", HERE / "startup.c"]
    link = [
        "-nostartfiles",
        "-T",
        HERE / "memory.ld",
        "-Wl,--gc-sections",
        "-lm",
        "-lc",
        "-lgcc",
    ]
    command = [
        "arm-none-eabi-gcc",
        *flags,
        f"-I{folder}",
        *sources,
        *link,
        "-o",
        program,
    ]
    subprocess.run([*map(str, command)], check=True, cwd=folder)
    names = subprocess.check_output(["arm-none-eabi-nm", program], text=True).split()
    assert not HEAP & {*names}, "the program needs a heap"
    return program


def definitions(folder):
    steps = "_step(" in (folder / "model.h").read_text()
    return [f"-DROWS={ROWS}", *([f"-DSTEPS={STEPS}"] * steps)]


def run(program, core):
    """Return the numbers that a program prints under qemu."""
    machine, _ = CORES[core]
    command = [
        "qemu-system-arm",
        "-M",
        machine,
        "-nographic",
        "-monitor",
        "none",
        "-serial",
        "none",
    ]
    command += [
        "-semihosting-config",
        "enable=on,target=native",
        "-kernel",
        str(program),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return numbers(done.stdout + done.stderr)


def on_desktop(folder):
    """Return the numbers of the same source on this machine."""
    say = folder / "say.c"
    say.write_text("#include <stdio.h>\nvoid say(const char *text) { fputs(text, stdout); }\n")
    program = folder / "desktop"
    sources = map(str, [folder / "model.c", HERE / "main.c", say])
    options = [
        "-std=gnu99",
        "-O2",
        "-fno-math-errno",
        *definitions(folder),
        f"-I{folder}",
    ]
    subprocess.run(["cc", *options, *sources, "-lm", "-o", program], check=True)
    return numbers(subprocess.check_output([program], text=True))


def numbers(text):
    """Return float32 numbers from their bits in hexadecimal digits."""
    words = [int(word, 16) for word in text.split()]
    return np.array(words, dtype=np.uint32).view(np.float32).astype(float)


def sizes(program):
    """Return bytes of flash and of RAM."""
    text, data, bss = subprocess.check_output(["arm-none-eabi-size", program], text=True).split()[
        6:9
    ]
    return int(text) + int(data), int(data) + int(bss)


def stack(folder):
    """Return the bytes of the stack of all functions of the exported code together."""
    (usage,) = folder.glob("*model.su")
    return sum(int(line.split("\t")[1]) for line in usage.read_text().splitlines())


def measured(model):
    """Return a row for each core: difference, flash, RAM, stack."""
    rows = {}
    for core in CORES:
        with tempfile.TemporaryDirectory() as home:
            folder = Path(home)
            native.export_c(model, folder, dtype="float32")
            desktop = on_desktop(folder)
            program = built(folder, core)
            difference = np.abs(run(program, core) - desktop).max() / np.abs(desktop).max()
            rows[core] = (difference, *sizes(program), stack(folder))
    return rows


def missing():
    """Return the programs that are not installed."""
    needed = ("arm-none-eabi-gcc", "qemu-system-arm", "cc")
    return [program for program in needed if shutil.which(program) is None]


if __name__ == "__main__":
    if missing():
        raise SystemExit(f"not installed: {', '.join(missing())}; see microcontroller.md")
    print("| model | core | difference | flash [kB] | RAM [B] | stack [kB] |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, model in models().items():
        for core, (difference, flash, ram, used) in measured(model).items():
            numbers_of_row = f"{difference:.1e} | {flash / 1e3:.1f} | {ram} | {used / 1e3:.1f}"
            print(f"| {name} | {core} | {numbers_of_row} |")
