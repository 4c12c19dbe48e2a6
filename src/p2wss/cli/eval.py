"""``p2wss eval``: reconstruct the evaluation buildings, measure the errors, and write the report."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from p2wss.cli.common import (
    Parsers,
    add_command,
    add_device,
    add_group,
    add_threads,
    log,
    log_status_counts,
    read_config,
    set_num_threads,
)
from p2wss.config import Config, dataset_name, section_json
from p2wss.provenance import fingerprint
from p2wss.storage import files
from p2wss.storage.temporary import temporary_folder


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss eval`` to the parser."""
    parts = add_group(stages, "eval", "evaluate the methods and write the report")
    _add_networks(parts)
    _add_baselines(parts)
    _add_measures(parts)
    _add_report(parts)


def _add_networks(parts: Parsers) -> None:
    """Commands that reconstruct buildings with a network or the fit, and the medians that they share."""
    command = add_command(
        parts,
        "medians",
        eval_medians,
        "compute the median height and angle that the constant baseline predicts",
    )
    _add_manifest(command)
    command.add_argument("--out", type=Path, required=True, help="JSON to write: the medians of the labels")

    command = add_command(
        parts, "predict", eval_predict, "reconstruct the test split and the real LiDAR with the network alone"
    )
    _add_shards(command)
    command.add_argument("--model", type=Path, required=True, help="weights written by p2wss model")
    _add_medians(command)
    _add_reconstruction_outputs(command)
    command.add_argument(
        "--out-errors",
        type=Path,
        required=True,
        help="JSON to write: errors with masked parameters (Table 1)",
    )
    add_threads(command)
    add_device(command)

    command = add_command(
        parts, "fit", eval_fit, "reconstruct the same buildings with the fit, as p2wss reconstruct does"
    )
    _add_shards(command)
    command.add_argument(
        "--model", type=Path, help="weights written by p2wss model (default: fit without a network)"
    )
    _add_reconstruction_outputs(command)
    add_threads(command)
    add_device(command)


def _add_baselines(parts: Parsers) -> None:
    """Commands that reconstruct buildings with a baseline."""
    command = add_command(parts, "baseline", eval_baseline, "reconstruct the same buildings with a baseline")
    command.add_argument("--name", required=True, help="name of the baseline: lod1, constant or roofer")
    _add_shards(command)
    _add_medians(command)
    _add_reconstruction_outputs(command)
    command.add_argument(
        "--recording",
        type=Path,
        help="Parquet written by p2wss eval recording (default: eval.roofer_recorded of the config)",
    )

    command = add_command(
        parts, "recording", eval_recording, "read recorded outputs of Roofer, once for all groups"
    )
    _add_manifest(command)
    command.add_argument(
        "--recorded", type=Path, nargs="+", required=True, metavar="CITYJSON", help="outputs of Roofer"
    )
    command.add_argument("--out", type=Path, required=True, help="Parquet to write: their solids")


def _add_measures(parts: Parsers) -> None:
    """Commands that measure the reconstructions."""
    command = add_command(parts, "measure", eval_measure, "measure the errors of all reconstructions")
    _add_shards(command)
    command.add_argument(
        "--reconstructions",
        type=Path,
        nargs="+",
        required=True,
        metavar="PARQUET",
        help="files written by p2wss eval predict, fit and baseline",
    )
    command.add_argument(
        "--out", type=Path, required=True, help="Parquet to write: one row per building and method"
    )
    command.add_argument(
        "--out-errors", type=Path, required=True, help="JSON to write: errors of our variants (Table 1)"
    )

    command = add_command(parts, "merge", eval_merge, "merge the measures of all groups of shards")
    _add_parts(command)
    command.add_argument("--methods", nargs="+", required=True, metavar="METHOD", help="methods to compare")
    command.add_argument(
        "--out-measures", type=Path, required=True, help="Parquet to write: one row per building and method"
    )
    command.add_argument(
        "--out-parameters", type=Path, required=True, help="JSON to write: the errors of Table 1"
    )
    command.add_argument(
        "--out-methods", type=Path, required=True, help="JSON to write: status and CPU time of each method"
    )

    command = add_command(parts, "ablation", eval_ablation, "compare the variants of the model")
    _add_manifest(command)
    command.add_argument(
        "--models",
        type=Path,
        nargs="+",
        required=True,
        help="weights of the variants: VARIANT/model.safetensors",
    )
    command.add_argument("--out-csv", type=Path, required=True, help="CSV to write: the table")
    command.add_argument("--out-markdown", type=Path, required=True, help="Markdown to write: the table")
    add_threads(command)
    add_device(command)


def _add_report(parts: Parsers) -> None:
    """The command that writes the report."""
    command = add_command(parts, "report", eval_report, "write the report")
    _add_manifest(command)
    for name in ("measures", "parameters", "methods"):
        command.add_argument(
            f"--{name}", type=Path, required=True, help=f"file written by p2wss eval merge --out-{name}"
        )
    _add_parts(command)
    command.add_argument(
        "--metrics",
        type=Path,
        nargs="*",
        required=True,
        metavar="JSONL",
        help="metrics written by p2wss dvae and p2wss model",
    )
    command.add_argument(
        "--scans", type=Path, nargs="*", default=[], metavar="PNG", help="images written by p2wss scans"
    )
    command.add_argument(
        "--out",
        type=Path,
        required=True,
        help="output folder: report.html, and its tables as CSV and LaTeX",
    )


def _add_manifest(command: argparse.ArgumentParser) -> None:
    command.add_argument("--manifest", type=Path, required=True, help="JSON written by p2wss crops manifest")


def _add_shards(command: argparse.ArgumentParser) -> None:
    _add_manifest(command)
    command.add_argument(
        "--shards",
        type=Path,
        nargs="+",
        metavar="SHARD",
        help="evaluate only these shards of the manifest (default: all)",
    )


def _add_medians(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--medians",
        type=Path,
        help="JSON written by p2wss eval medians (default: the medians of the shards that are evaluated)",
    )


def _add_parts(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--parts",
        type=Path,
        nargs="+",
        required=True,
        metavar="FOLDER",
        help="one folder per group of shards, with METHOD.parquet and cpu/METHOD.json of each method, "
        "measures.parquet, masked_errors.json (predict), variant_errors.json (measure)",
    )


def _add_reconstruction_outputs(command: argparse.ArgumentParser) -> None:
    command.add_argument("--out", type=Path, required=True, help="Parquet to write: the reconstructions")
    command.add_argument(
        "--out-cpu", type=Path, required=True, help="JSON to write: CPU time and number of buildings"
    )


def eval_medians(arguments: argparse.Namespace) -> None:
    """Write the medians of the labels."""
    from p2wss.eval import cases
    from p2wss.storage.schemas.manifest import read_manifest

    medians = cases.train_medians(read_manifest(arguments.manifest))
    medians.write(arguments.out)
    log.info(f"{arguments.out.name}: {medians.eave_height_m:.3f} m, {medians.angle_deg:.1f} degrees")


def eval_predict(arguments: argparse.Namespace) -> None:
    """Write the reconstructions of the network, and its errors with masked parameters (Table 1)."""
    set_num_threads(arguments.threads)
    from p2wss.eval import cases, parameters, predict
    from p2wss.eval.clock import CpuClock
    from p2wss.nets.predictor import load_predictor
    from p2wss.reconstruct.product import NETWORK
    from p2wss.storage.schemas.manifest import read_manifest

    config, clock = read_config(arguments), CpuClock()
    predictor = load_predictor(arguments.model, arguments.device)
    manifest = read_manifest(arguments.manifest, arguments.shards)
    medians = cases.read_medians(arguments.medians) if arguments.medians else cases.train_medians(manifest)
    facts = _eval_facts(config, method=NETWORK, status="ok", model=_facts_of_weights(arguments.model))
    errors = []
    with _reconstructions(arguments, clock, facts) as write:
        for test_cases in cases.test_cases(manifest):
            rows = predict.predict(test_cases, predictor, config.reconstruct, clock)
            write(test_cases, rows)
            errors.append(parameters.masked_errors(test_cases, rows, predictor, medians, config.reconstruct))
    files.write_json(arguments.out_errors, parameters.merged(errors) | {"p2wss": facts})


def eval_fit(arguments: argparse.Namespace) -> None:
    """Write the reconstructions of the fit, with or without the network."""
    set_num_threads(arguments.threads)
    from p2wss.eval import cases, predict
    from p2wss.eval.clock import CpuClock
    from p2wss.nets.predictor import load_predictor
    from p2wss.reconstruct.product import FIT, NETWORK_AND_FIT
    from p2wss.storage.schemas.manifest import read_manifest

    config, clock = read_config(arguments), CpuClock()
    facts: dict[str, Any] = {"method": FIT, "status": "ok"}
    predictor = None
    if arguments.model is not None:
        predictor = load_predictor(arguments.model, arguments.device)
        facts = {"method": NETWORK_AND_FIT, "status": "ok", "model": _facts_of_weights(arguments.model)}
    with _reconstructions(arguments, clock, _eval_facts(config, **facts)) as write:
        for test_cases in cases.test_cases(read_manifest(arguments.manifest, arguments.shards)):
            write(test_cases, predict.fit(test_cases, predictor, config.reconstruct, clock))


def _facts_of_weights(path: Path) -> dict[str, Any]:
    from p2wss.nets.weights import read_weights

    facts = read_weights(path, "model")[1]
    return {name: facts[name] for name in ("version", "code", "config", "dvae_config")}


def eval_recording(arguments: argparse.Namespace) -> None:
    """Write the solids of recorded outputs of Roofer, and how many of the evaluated buildings they are of."""
    from p2wss.eval.recording import write_recording
    from p2wss.storage.schemas.manifest import read_manifest

    recording = write_recording(arguments.recorded, read_manifest(arguments.manifest), arguments.out)
    log.info("%s: %d of the evaluated buildings", arguments.out.name, recording.num_evaluated)


@contextmanager
def _recording(arguments: argparse.Namespace, config: Config, manifest: Any) -> Iterator[Any]:
    """What ``--recording`` names, or else what the config names, read into a temporary file; None without either."""
    from p2wss.eval import roofer_command
    from p2wss.eval.recording import read_recording, write_recording

    paths = roofer_command.recorded_files(config.eval) if arguments.name == "roofer" else []
    with temporary_folder("recording") as folder:
        if arguments.recording is not None:
            yield read_recording(arguments.recording)
        else:
            yield write_recording(paths, manifest, folder / "recording.parquet") if paths else None


def eval_baseline(arguments: argparse.Namespace) -> None:
    """Write the reconstructions of a baseline."""
    from p2wss.eval import baselines, cases, parts
    from p2wss.eval.clock import CpuClock
    from p2wss.storage.schemas.manifest import read_manifest

    config, clock = read_config(arguments), CpuClock()
    manifest = read_manifest(arguments.manifest, arguments.shards)
    medians = cases.read_medians(arguments.medians) if arguments.medians else None
    runs = []
    facts: dict[str, Any] = {"method": arguments.name}
    with (
        _recording(arguments, config, manifest) as recording,
        _reconstructions(arguments, clock, facts) as write,
    ):
        for test_cases in cases.test_cases(manifest):
            reconstructions, run = baselines.baseline(
                arguments.name,
                test_cases,
                manifest,
                config.eval,
                config.reconstruct,
                clock,
                medians,
                recording,
            )
            runs.append(run)
            test_cases = [case for case in test_cases if case.key in reconstructions]
            write(test_cases, [reconstructions[case.key] for case in test_cases])
        run = parts.merge_facts(runs)
        facts |= _eval_facts(config, **run)
    log.info("%s: %s", arguments.name, run["status"])


@contextmanager
def _reconstructions(
    arguments: argparse.Namespace, clock: Any, facts: dict[str, Any]
) -> Iterator[Callable[[Any, Any], None]]:
    """A function that writes cases and their reconstructions to ``--out``; the facts are those of the end."""
    from p2wss.storage.schemas.reconstructions import RECONSTRUCTIONS, reconstruction_columns

    status: list[str] = []
    with files.table_writer(arguments.out, RECONSTRUCTIONS) as writer:

        def write(test_cases: Any, rows: Any) -> None:
            columns = reconstruction_columns(rows, [case.dataset for case in test_cases])
            status.extend(columns["status"])
            writer.append(columns)

        yield write
        writer.metadata = facts
    times = {"seconds": clock.seconds, "num_buildings": clock.num_buildings}
    files.write_json(arguments.out_cpu, {"method": facts["method"], **times})
    log_status_counts(arguments.out, status)


def eval_measure(arguments: argparse.Namespace) -> None:
    """Write the measures of all reconstructions, and the errors of our variants."""
    from p2wss.eval import cases, measure, parameters
    from p2wss.storage.schemas.manifest import read_manifest
    from p2wss.storage.schemas.measures import MEASURES
    from p2wss.storage.schemas.reconstructions import read_reconstructions

    config = read_config(arguments)
    paths = {str(files.read_metadata(path)["method"]): path for path in arguments.reconstructions}
    errors, num_rows = [], 0
    with files.table_writer(arguments.out, MEASURES) as writer:
        for test_cases in cases.test_cases(read_manifest(arguments.manifest, arguments.shards)):
            keys = [case.key for case in test_cases]
            methods = {method: read_reconstructions(path, keys) for method, path in paths.items()}
            rows = list(measure.measure(test_cases, methods, config.eval))
            writer.append(cases.columns_of(rows, MEASURES.names))
            errors.append(parameters.variant_errors(test_cases, methods))
            num_rows += len(rows)
        writer.metadata = _eval_facts(config)
    files.write_json(arguments.out_errors, parameters.merged(errors))
    log.info("%s: %d rows", arguments.out, num_rows)


def eval_merge(arguments: argparse.Namespace) -> None:
    """Write the measures, errors and CPU times of all parts as one."""
    from p2wss.eval import parts

    facts = _eval_facts(read_config(arguments))
    folders = [parts.Part(folder) for folder in arguments.parts]
    num_rows = parts.merge_measures(folders, arguments.methods, arguments.out_measures, facts)
    files.write_json(arguments.out_parameters, parts.merge_errors(folders) | {"p2wss": facts})
    methods = parts.merge_methods(folders, arguments.methods)
    files.write_json(arguments.out_methods, {"methods": methods, "p2wss": facts})
    log.info("%s: %d rows of %d parts", arguments.out_measures, num_rows, len(folders))


def eval_ablation(arguments: argparse.Namespace) -> None:
    """Write the table of the ablation as CSV and Markdown."""
    set_num_threads(arguments.threads)
    from p2wss.eval import ablation

    rows = ablation.measure(arguments.manifest, arguments.models, arguments.device)
    files.write_text(arguments.out_csv, ablation.csv(rows))
    files.write_text(arguments.out_markdown, ablation.markdown(rows))
    log.info("%s", ablation.markdown(rows))


def eval_report(arguments: argparse.Namespace) -> None:
    """Write the report and its tables."""
    from p2wss.eval import attribution, report

    config = read_config(arguments)
    table = attribution.read(config.fetch.sources)
    from_sources = {
        "attribution": [*attribution.attribution(config, table), *config.eval.attribution],
        "lidar_name": attribution.lidar_name(config, table),
    }
    inputs = report.read(
        dataset_name(config),
        arguments.manifest,
        arguments.measures,
        arguments.parameters,
        arguments.methods,
        arguments.parts,
        arguments.metrics,
        config.eval.model_copy(update=from_sources),
        arguments.scans,
    )
    for name, text in report.documents(inputs).items():
        files.write_text(arguments.out / name, text)
    log.info("%s", arguments.out / "report.html")


def _eval_facts(config: Config, **facts: Any) -> dict[str, Any]:
    settings = section_json(config, "eval", "reconstruct")
    return files.provenance(config=settings, code=fingerprint("eval"), **facts)
