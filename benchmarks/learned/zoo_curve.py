"""The error of the zoo's flow maps against the length of their training.

    python benchmarks/learned/zoo_curve.py          # trains with fewer epochs: ten minutes
    python benchmarks/learned/zoo_curve.py --table  # only print the table of the results
    python benchmarks/learned/zoo_curve.py --figure docs/images/zoo-training.svg
    python benchmarks/learned/zoo_curve.py --smoke  # toy sizes, to see that it runs

The last point of each curve is the network of the zoo with the same seed. One JSON file for each
system goes to `benchmarks/results/zoo-curve/`.
"""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import trained
import zoo

import diffrax_conserve as dfc

RESULTS = zoo.ROOT / "results" / "zoo-curve"
EPOCHS = {"conservative-lorenz": [200, 400, 800], "point-vortices": [100, 200, 400]}
SEED = 0
ERRORS = {"one_step_rms": "one step", "largest_state_error": "500 steps, projected"}


def measure(name, epochs, specs, steps, states):
    system, spec = dfc.systems.get(name), specs[name]
    shorter = dataclasses.replace(spec, epochs=epochs)
    network, _, (seconds, cpu_seconds) = zoo.train(system, shorter, SEED)
    fresh, exact, y0s, ts, reference = zoo.judged_on(name, spec, steps, states)
    solver = dfc.DeepONetSolver(network)
    projected = dfc.ManifoldProjection(solver, system.manifold)
    errors = zoo.rollout(system, projected, y0s, ts, reference)
    return {
        "epochs": epochs,
        "seconds": round(seconds, 1),
        "cpu_seconds": round(cpu_seconds, 1),
        "one_step_rms": zoo.one_step(system, solver, fresh, exact)[0],
        "largest_state_error": errors["largest_state_error"],
    }


def of_the_zoo(name):
    """The last point, from what `zoo.py` measured."""
    record = json.loads((zoo.RESULTS / f"{name}-{SEED}.json").read_text())
    return {
        "epochs": zoo.SPECS[name].epochs,
        "seconds": record["seconds"],
        "cpu_seconds": record["cpu_seconds"],
        "one_step_rms": record["errors"]["plain"]["one_step_rms"],
        "largest_state_error": record["errors"]["projected"]["largest_state_error"],
    }


def read_results():
    found = {name: json.loads((RESULTS / f"{name}.json").read_text()) for name in EPOCHS}
    return {name: [*points, of_the_zoo(name)] for name, points in found.items()}


def table(results):
    lines = ["| system | epochs | s | one step | 500 steps, projected |", "|---|---|---|---|---|"]
    for name, points in results.items():
        for p in points:
            end = trained.error(p["largest_state_error"])
            cells = [f"`{name}`", f"{p['epochs']:,}", f"{p['cpu_seconds']:.0f}"]
            lines.append("| " + " | ".join([*cells, f"{p['one_step_rms']:.1e}", end]) + " |")
    return "\n".join(lines)


def draw(results, path):
    import matplotlib as mpl

    from diffrax_conserve.reproduce import _plot

    panels = {}
    for name, points in results.items():
        # Not the seconds: other work on the cores puts some of them in the wrong order.
        epochs = np.array([p["epochs"] for p in points])
        curves = {}
        for key, label in ERRORS.items():
            errors = [np.nan if p[key] is None else p[key] for p in points]
            curves[label] = (epochs, np.array(errors))
        panels[dfc.systems.get(name).title] = curves
    with mpl.rc_context(_plot._STYLE):
        _plot.save(error_of_training(_plot, panels), Path(path))


def error_of_training(plot, panels):
    """One panel for each problem, one curve for each kind of error."""
    figure = plot.Figure(figsize=(3.5 * len(panels), 2.7), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for ax, (title, curves) in zip(axes, panels.items(), strict=True):
        for name, (epochs, errors) in curves.items():
            ax.plot(epochs, errors, "o-", markersize=3, label=name)
        ax.set_xlim(left=0)
        ax.xaxis.set_major_locator(plot.MaxNLocator(5))
        ax.set_yscale("log")
        ax.set_title(title)
        ax.set_xlabel("epochs of training")
    axes[0].set_ylabel("error")
    plot._legend(figure, axes[0])
    return figure


def main(argv=None):
    jax.config.update("jax_enable_x64", True)
    parser = trained.parser(__doc__, EPOCHS)
    parser.add_argument("--figure", help="only draw the results, to this file")
    options = parser.parse_args(argv)
    if options.table:
        print(table(read_results()))
        return None
    if options.figure:
        return draw(read_results(), options.figure)
    if options.smoke:
        point = measure("conservative-lorenz", 2, zoo.SMOKE, steps=2, states=10)
        print(json.dumps(point))
        return point
    for name in options.system or EPOCHS:
        system = dfc.systems.get(name)
        # The first training compiles what all share. That of the zoo's seed 0 was not the first.
        zoo.train(system, dataclasses.replace(zoo.SPECS[name], epochs=1), SEED)
        steps = round(system.t1 / system.dt)
        points = [measure(name, epochs, zoo.SPECS, steps, 1000) for epochs in EPOCHS[name]]
        RESULTS.mkdir(parents=True, exist_ok=True)
        (RESULTS / f"{name}.json").write_text(json.dumps(points, indent=1) + "\n")
        print(json.dumps(points))
    return None


if __name__ == "__main__":
    main()
