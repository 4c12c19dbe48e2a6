"""``p2wss eval``: reconstruct the evaluation buildings, measure the errors, and write the report."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from p2wss.cli.common import (
    config_option,
    device_option,
    log,
    log_status_counts,
    manifest_option,
    set_num_threads,
    threads_option,
)
from p2wss.cli.parser import Group, file_option, option
from p2wss.config import Config, dataset_name, section_json
from p2wss.provenance import fingerprint
from p2wss.storage import files
from p2wss.storage.temporary import temporary_folder

if TYPE_CHECKING:
    from p2wss.nets.compute import DeviceName

_shards_option = file_option(
    "--shards", "evaluate only these shards of the manifest (default: all)", required=False, takes_list=True
)
_medians_option = file_option(
    "--medians",
    "JSON written by p2wss eval medians (default: the medians of the shards that are evaluated)",
    required=False,
)
_parts_option = file_option(
    "--parts",
    "one folder per group of shards, with METHOD.parquet and cpu/METHOD.json of each method, measures.parquet, "
    "masked_errors.json (predict), variant_errors.json (measure)",
    takes_list=True,
)
_out_option = file_option("--out", "Parquet to write: the reconstructions")
_out_cpu_option = file_option("--out-cpu", "JSON to write: CPU time and number of buildings")


@click.group(cls=Group)
def eval() -> None:
    """Evaluate the methods and write the report."""


@eval.command("medians")
@manifest_option
@file_option("--out", "JSON to write: the medians of the labels")
def eval_medians(manifest: Path, out: Path) -> None:
    """Compute the median height and angle that the constant baseline predicts."""
    from p2wss.eval import cases
    from p2wss.storage.schemas.manifest import read_manifest

    medians = cases.train_medians(read_manifest(manifest))
    medians.write(out)
    log.info(f"{out.name}: {medians.eave_height_m:.3f} m, {medians.angle_deg:.1f} degrees")


@eval.command("predict")
@manifest_option
@_shards_option
@file_option("--model", "weights written by p2wss model")
@_medians_option
@_out_option
@_out_cpu_option
@file_option("--out-errors", "JSON to write: errors with masked parameters (Table 1)")
@threads_option
@device_option
@config_option
def eval_predict(
    manifest: Path,
    shards: tuple[Path, ...],
    model: Path,
    medians: Path | None,
    out: Path,
    out_cpu: Path,
    out_errors: Path,
    threads: int,
    device: DeviceName,
    config: Config,
) -> None:
    """Reconstruct the test split and the real LiDAR with the network alone."""
    set_num_threads(threads)
    from p2wss.eval import cases, parameters, predict
    from p2wss.eval.clock import CpuClock
    from p2wss.nets.predictor import load_predictor
    from p2wss.reconstruct.product import NETWORK
    from p2wss.storage.schemas.manifest import read_manifest

    clock = CpuClock()
    predictor = load_predictor(model, device)
    listed = read_manifest(manifest, shards or None)
    labels = cases.read_medians(medians) if medians else cases.train_medians(listed)
    facts = _eval_facts(config, method=NETWORK, status="ok", model=_facts_of_weights(model))
    errors = []
    with _reconstructions(out, out_cpu, clock, facts) as write:
        for test_cases in cases.test_cases(listed):
            rows = predict.predict(test_cases, predictor, config.reconstruct, clock)
            write(test_cases, rows)
            errors.append(parameters.masked_errors(test_cases, rows, predictor, labels, config.reconstruct))
    files.write_json(out_errors, parameters.merged(errors) | {"p2wss": facts})


@eval.command("fit")
@manifest_option
@_shards_option
@file_option("--model", "weights written by p2wss model (default: fit without a network)", required=False)
@_out_option
@_out_cpu_option
@threads_option
@device_option
@config_option
def eval_fit(
    manifest: Path,
    shards: tuple[Path, ...],
    model: Path | None,
    out: Path,
    out_cpu: Path,
    threads: int,
    device: DeviceName,
    config: Config,
) -> None:
    """Reconstruct the same buildings with the fit, as p2wss reconstruct does."""
    set_num_threads(threads)
    from p2wss.eval import cases, predict
    from p2wss.eval.clock import CpuClock
    from p2wss.nets.predictor import load_predictor
    from p2wss.reconstruct.product import FIT, NETWORK_AND_FIT
    from p2wss.storage.schemas.manifest import read_manifest

    clock = CpuClock()
    facts: dict[str, Any] = {"method": FIT, "status": "ok"}
    predictor = None
    if model is not None:
        predictor = load_predictor(model, device)
        facts = {"method": NETWORK_AND_FIT, "status": "ok", "model": _facts_of_weights(model)}
    with _reconstructions(out, out_cpu, clock, _eval_facts(config, **facts)) as write:
        for test_cases in cases.test_cases(read_manifest(manifest, shards or None)):
            write(test_cases, predict.fit(test_cases, predictor, config.reconstruct, clock))


def _facts_of_weights(path: Path) -> dict[str, Any]:
    from p2wss.nets.weights import read_weights

    facts = read_weights(path, "model")[1]
    return {name: facts[name] for name in ("version", "code", "config", "dvae_config")}


@eval.command("recording")
@manifest_option
@file_option("--recorded", "outputs of Roofer", takes_list=True)
@file_option("--out", "Parquet to write: their solids")
def eval_recording(manifest: Path, recorded: tuple[Path, ...], out: Path) -> None:
    """Read recorded outputs of Roofer, once for all groups."""
    from p2wss.eval.recording import write_recording
    from p2wss.storage.schemas.manifest import read_manifest

    recording = write_recording(list(recorded), read_manifest(manifest), out)
    log.info("%s: %d of the evaluated buildings", out.name, recording.num_evaluated)


@contextmanager
def _recording(path: Path | None, name: str, config: Config, manifest: Any) -> Iterator[Any]:
    """What ``--recording`` names, or else what the config names, read into a temporary file; None without either."""
    from p2wss.eval import roofer_command
    from p2wss.eval.recording import read_recording, write_recording

    paths = roofer_command.recorded_files(config.eval) if name == "roofer" else []
    with temporary_folder("recording") as folder:
        if path is not None:
            yield read_recording(path)
        else:
            yield write_recording(paths, manifest, folder / "recording.parquet") if paths else None


@eval.command("baseline")
@option("--name", required=True, help="name of the baseline: lod1, constant or roofer")
@manifest_option
@_shards_option
@_medians_option
@_out_option
@_out_cpu_option
@file_option(
    "--recording",
    "Parquet written by p2wss eval recording (default: eval.roofer_recorded of the config)",
    required=False,
)
@config_option
def eval_baseline(
    name: str,
    manifest: Path,
    shards: tuple[Path, ...],
    medians: Path | None,
    out: Path,
    out_cpu: Path,
    recording: Path | None,
    config: Config,
) -> None:
    """Reconstruct the same buildings with a baseline."""
    from p2wss.eval import baselines, cases, parts
    from p2wss.eval.clock import CpuClock
    from p2wss.storage.schemas.manifest import read_manifest

    clock = CpuClock()
    listed = read_manifest(manifest, shards or None)
    labels = cases.read_medians(medians) if medians else None
    runs = []
    facts: dict[str, Any] = {"method": name}
    with (
        _recording(recording, name, config, listed) as recorded,
        _reconstructions(out, out_cpu, clock, facts) as write,
    ):
        for test_cases in cases.test_cases(listed):
            reconstructions, run = baselines.baseline(
                name,
                test_cases,
                listed,
                config.eval,
                config.reconstruct,
                clock,
                labels,
                recorded,
            )
            runs.append(run)
            test_cases = [case for case in test_cases if case.key in reconstructions]
            write(test_cases, [reconstructions[case.key] for case in test_cases])
        run = parts.merge_facts(runs)
        facts |= _eval_facts(config, **run)
    log.info("%s: %s", name, run["status"])


@contextmanager
def _reconstructions(
    out: Path, out_cpu: Path, clock: Any, facts: dict[str, Any]
) -> Iterator[Callable[[Any, Any], None]]:
    """A function that writes cases and their reconstructions to ``--out``; the facts are those of the end."""
    from p2wss.storage.schemas.reconstructions import RECONSTRUCTIONS, reconstruction_columns

    status: list[str] = []
    with files.table_writer(out, RECONSTRUCTIONS) as writer:

        def write(test_cases: Any, rows: Any) -> None:
            columns = reconstruction_columns(rows, [case.dataset for case in test_cases])
            status.extend(columns["status"])
            writer.append(columns)

        yield write
        writer.metadata = facts
    times = {"seconds": clock.seconds, "num_buildings": clock.num_buildings}
    files.write_json(out_cpu, {"method": facts["method"], **times})
    log_status_counts(out, status)


@eval.command("measure")
@manifest_option
@_shards_option
@file_option("--reconstructions", "files written by p2wss eval predict, fit and baseline", takes_list=True)
@file_option("--out", "Parquet to write: one row per building and method")
@file_option("--out-errors", "JSON to write: errors of our variants (Table 1)")
@config_option
def eval_measure(
    manifest: Path,
    shards: tuple[Path, ...],
    reconstructions: tuple[Path, ...],
    out: Path,
    out_errors: Path,
    config: Config,
) -> None:
    """Measure the errors of all reconstructions."""
    from p2wss.eval import cases, measure, parameters
    from p2wss.storage.schemas.manifest import read_manifest
    from p2wss.storage.schemas.measures import MEASURES
    from p2wss.storage.schemas.reconstructions import read_reconstructions

    paths = {str(files.read_metadata(path)["method"]): path for path in reconstructions}
    errors, num_rows = [], 0
    with files.table_writer(out, MEASURES) as writer:
        for test_cases in cases.test_cases(read_manifest(manifest, shards or None)):
            keys = [case.key for case in test_cases]
            methods = {method: read_reconstructions(path, keys) for method, path in paths.items()}
            rows = list(measure.measure(test_cases, methods, config.eval))
            writer.append(cases.columns_of(rows, MEASURES.names))
            errors.append(parameters.variant_errors(test_cases, methods))
            num_rows += len(rows)
        writer.metadata = _eval_facts(config)
    files.write_json(out_errors, parameters.merged(errors))
    log.info("%s: %d rows", out, num_rows)


@eval.command("merge")
@_parts_option
@option("--methods", required=True, takes_list=True, metavar="METHOD", help="methods to compare")
@file_option("--out-measures", "Parquet to write: one row per building and method")
@file_option("--out-parameters", "JSON to write: the errors of Table 1")
@file_option("--out-methods", "JSON to write: status and CPU time of each method")
@config_option
def eval_merge(
    parts: tuple[Path, ...],
    methods: tuple[str, ...],
    out_measures: Path,
    out_parameters: Path,
    out_methods: Path,
    config: Config,
) -> None:
    """Merge the measures of all groups of shards."""
    from p2wss.eval.parts import Part, merge_errors, merge_measures, merge_methods

    facts = _eval_facts(config)
    folders = [Part(folder) for folder in parts]
    num_rows = merge_measures(folders, methods, out_measures, facts)
    files.write_json(out_parameters, merge_errors(folders) | {"p2wss": facts})
    files.write_json(out_methods, {"methods": merge_methods(folders, methods), "p2wss": facts})
    log.info("%s: %d rows of %d parts", out_measures, num_rows, len(folders))


@eval.command("ablation")
@manifest_option
@file_option("--models", "weights of the variants: VARIANT/model.safetensors", takes_list=True)
@file_option("--out-csv", "CSV to write: the table")
@file_option("--out-markdown", "Markdown to write: the table")
@threads_option
@device_option
def eval_ablation(
    manifest: Path,
    models: tuple[Path, ...],
    out_csv: Path,
    out_markdown: Path,
    threads: int,
    device: DeviceName,
) -> None:
    """Compare the variants of the model."""
    set_num_threads(threads)
    from p2wss.eval import ablation

    rows = ablation.measure(manifest, models, device)
    files.write_text(out_csv, ablation.csv(rows))
    files.write_text(out_markdown, ablation.markdown(rows))
    log.info("%s", ablation.markdown(rows))


@eval.command("report")
@manifest_option
@file_option("--measures", "file written by p2wss eval merge --out-measures")
@file_option("--parameters", "file written by p2wss eval merge --out-parameters")
@file_option("--methods", "file written by p2wss eval merge --out-methods")
@_parts_option
@file_option("--metrics", "metrics written by p2wss dvae and p2wss model", required=False, takes_list=True)
@file_option("--scans", "images written by p2wss scans", required=False, takes_list=True)
@file_option("--out", "output folder: report.html, and its tables as CSV and LaTeX")
@config_option
def eval_report(
    manifest: Path,
    measures: Path,
    parameters: Path,
    methods: Path,
    parts: tuple[Path, ...],
    metrics: tuple[Path, ...],
    scans: tuple[Path, ...],
    out: Path,
    config: Config,
) -> None:
    """Write the report."""
    from p2wss.eval import attribution, report

    table = attribution.read(config.fetch.sources)
    from_sources = {
        "attribution": [*attribution.attribution(config, table), *config.eval.attribution],
        "lidar_name": attribution.lidar_name(config, table),
    }
    inputs = report.read(
        dataset_name(config),
        manifest,
        measures,
        parameters,
        methods,
        parts,
        metrics,
        config.eval.model_copy(update=from_sources),
        scans,
    )
    for name, text in report.documents(inputs).items():
        files.write_text(out / name, text)
    log.info("%s", out / "report.html")


def _eval_facts(config: Config, **facts: Any) -> dict[str, Any]:
    settings = section_json(config, "eval", "reconstruct")
    return files.provenance(config=settings, code=fingerprint("eval"), **facts)
