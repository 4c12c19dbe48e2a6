"""``p2wss eval``: reconstruct the evaluation buildings, measure the errors, and write the report."""

from __future__ import annotations

import argparse
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
from p2wss.config import Config, section_json
from p2wss.data import files
from p2wss.provenance import fingerprint


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss eval`` to the parser."""
    parts = add_group(stages, "eval", "evaluate the methods and write the report")
    command = add_command(
        parts, "predict", eval_predict, "reconstruct the test split and the real LiDAR with the network alone"
    )
    _add_manifest(command)
    command.add_argument("--model", type=Path, required=True, help="weights written by p2wss model")
    _add_reconstruction_outputs(command)
    command.add_argument(
        "--out-parameters", type=Path, required=True, help="JSON to write: the errors of Table 1"
    )
    add_threads(command)
    add_device(command)

    command = add_command(
        parts, "fit", eval_fit, "reconstruct the same buildings as p2wss reconstruct does, with a fit"
    )
    _add_manifest(command)
    command.add_argument(
        "--model", type=Path, help="weights written by p2wss model (default: fit without a network)"
    )
    _add_reconstruction_outputs(command)
    add_threads(command)
    add_device(command)

    command = add_command(parts, "baseline", eval_baseline, "reconstruct the same buildings with a baseline")
    command.add_argument("--name", required=True, help="name of the baseline: lod1, constant or roofer")
    _add_manifest(command)
    _add_reconstruction_outputs(command)

    command = add_command(parts, "measure", eval_measure, "measure the errors of all reconstructions")
    _add_manifest(command)
    _add_reconstructions(command)
    command.add_argument(
        "--out", type=Path, required=True, help="Parquet to write: one row per building and method"
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

    command = add_command(parts, "report", eval_report, "write the report")
    _add_manifest(command)
    command.add_argument("--measures", type=Path, required=True, help="Parquet written by p2wss eval measure")
    command.add_argument(
        "--parameters", type=Path, required=True, help="JSON written by p2wss eval predict --out-parameters"
    )
    _add_reconstructions(command)
    command.add_argument(
        "--cpu",
        type=Path,
        nargs="*",
        default=[],
        metavar="JSON",
        help="files written with --out-cpu, one per method",
    )
    command.add_argument(
        "--metrics",
        type=Path,
        nargs="*",
        required=True,
        metavar="JSONL",
        help="metrics written by p2wss dvae and p2wss model",
    )
    command.add_argument(
        "--scans", type=Path, nargs="*", default=[], metavar="PNG", help="pictures written by p2wss scans"
    )
    command.add_argument(
        "--out",
        type=Path,
        required=True,
        help="folder to write: report.html, and its tables as CSV and LaTeX",
    )


def _add_manifest(command: argparse.ArgumentParser) -> None:
    command.add_argument("--manifest", type=Path, required=True, help="JSON written by p2wss crops manifest")


def _add_reconstructions(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--reconstructions",
        type=Path,
        nargs="+",
        required=True,
        metavar="PARQUET",
        help="files written by p2wss eval predict, fit and baseline",
    )


def _add_reconstruction_outputs(command: argparse.ArgumentParser) -> None:
    command.add_argument("--out", type=Path, required=True, help="Parquet to write: the reconstructions")
    command.add_argument("--out-cpu", type=Path, required=True, help="JSON to write: CPU time per building")


def eval_predict(arguments: argparse.Namespace) -> None:
    """Write the reconstructions of the network, and its errors with masked parameters (Table 1)."""
    set_num_threads(arguments.threads)
    from p2wss.data.schemas.manifest import read_manifest
    from p2wss.eval import cases, parameters, predict
    from p2wss.eval.clock import CpuClock
    from p2wss.nets.predictor import load_predictor
    from p2wss.reconstruct.product import NETWORK

    config, clock = read_config(arguments), CpuClock()
    predictor = load_predictor(arguments.model, arguments.device)
    manifest = read_manifest(arguments.manifest)
    test_cases = cases.test_cases(manifest)
    rows = predict.predict(test_cases, predictor, config.reconstruct, clock)
    errors = parameters.masked_errors(test_cases, rows, predictor, cases.train_medians(manifest))
    facts = _eval_facts(config, method=NETWORK, status="ok", model=_facts_of_weights(arguments.model))
    files.write_json(arguments.out_parameters, errors | {"p2wss": facts})
    _write_reconstructions(arguments, test_cases, rows, facts, clock)


def eval_fit(arguments: argparse.Namespace) -> None:
    """Write the reconstructions of the fit, with or without the network."""
    set_num_threads(arguments.threads)
    from p2wss.data.schemas.manifest import read_manifest
    from p2wss.eval import cases, predict
    from p2wss.eval.clock import CpuClock
    from p2wss.nets.predictor import load_predictor
    from p2wss.reconstruct.product import FIT, NETWORK_AND_FIT

    config, clock = read_config(arguments), CpuClock()
    test_cases = cases.test_cases(read_manifest(arguments.manifest))
    facts: dict[str, Any] = {"method": FIT, "status": "ok"}
    predictor = None
    if arguments.model is not None:
        predictor = load_predictor(arguments.model, arguments.device)
        facts = {"method": NETWORK_AND_FIT, "status": "ok", "model": _facts_of_weights(arguments.model)}
    rows = predict.fit(test_cases, predictor, config.reconstruct, clock)
    _write_reconstructions(arguments, test_cases, rows, _eval_facts(config, **facts), clock)


def _facts_of_weights(path: Path) -> dict[str, Any]:
    from p2wss.nets.weights import read_weights

    facts = read_weights(path, "model")[1]
    return {name: facts[name] for name in ("version", "code", "config", "dvae_config")}


def eval_baseline(arguments: argparse.Namespace) -> None:
    """Write the reconstructions of a baseline."""
    from p2wss.data.schemas.manifest import read_manifest
    from p2wss.eval import baselines, cases
    from p2wss.eval.clock import CpuClock

    config, clock = read_config(arguments), CpuClock()
    manifest = read_manifest(arguments.manifest)
    test_cases = cases.test_cases(manifest)
    reconstructions, run = baselines.baseline(
        arguments.name, test_cases, manifest, config.eval, config.reconstruct, clock
    )
    test_cases = [case for case in test_cases if case.key in reconstructions]
    rows = [reconstructions[case.key] for case in test_cases]
    log.info("%s: %s", arguments.name, run["status"])
    facts = _eval_facts(config, method=arguments.name, **run)
    _write_reconstructions(arguments, test_cases, rows, facts, clock)


def _write_reconstructions(
    arguments: argparse.Namespace, test_cases: Any, rows: Any, facts: dict[str, Any], clock: Any
) -> None:
    from p2wss.data.schemas.reconstructions import RECONSTRUCTIONS, reconstruction_columns

    columns = reconstruction_columns(rows, [case.dataset for case in test_cases])
    files.write_table(arguments.out, columns, RECONSTRUCTIONS, facts)
    files.write_json(arguments.out_cpu, {"method": facts["method"], "cpu_ms": clock.ms_per_building()})
    log_status_counts(arguments.out, columns["status"])


def eval_measure(arguments: argparse.Namespace) -> None:
    """Write the measures of all reconstructions."""
    from p2wss.data.schemas.manifest import read_manifest
    from p2wss.data.schemas.measures import MEASURES
    from p2wss.data.schemas.reconstructions import read_reconstructions
    from p2wss.eval import cases, measure

    config = read_config(arguments)
    test_cases = cases.test_cases(read_manifest(arguments.manifest))
    methods = [read_reconstructions(path) for path in arguments.reconstructions]
    rows = cases.columns_of(measure.measure(test_cases, methods, config.eval), MEASURES.names)
    files.write_table(arguments.out, rows, MEASURES, _eval_facts(config))
    log.info("%s: %d rows", arguments.out, len(rows["method"]))


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
    sources = attribution.attribution(config, attribution.read(config.fetch.sources))
    footer = {"attribution": [*sources, *config.eval.attribution]}
    inputs = report.read(
        config.region.name,
        arguments.manifest,
        arguments.measures,
        arguments.parameters,
        arguments.reconstructions,
        arguments.cpu,
        arguments.metrics,
        config.eval.model_copy(update=footer),
        arguments.scans,
    )
    for name, text in report.documents(inputs).items():
        files.write_text(arguments.out / name, text)
    log.info("%s", arguments.out / "report.html")


def _eval_facts(config: Config, **facts: Any) -> dict[str, Any]:
    settings = section_json(config, "eval", "reconstruct")
    return files.provenance(config=settings, code=fingerprint("eval"), **facts)
