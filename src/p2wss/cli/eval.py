"""``p2wss eval``: reconstructions, measures, tables and the report."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from p2wss.cli.common import (
    DEVICES,
    Parsers,
    add_command,
    add_group,
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
    evaluate = add_group(stages, "eval", "tables, figures, report")
    command = add_command(
        evaluate, "predict", eval_predict, "reconstruct test split and real LiDAR with the model"
    )
    command.add_argument("--manifest", type=Path, required=True)
    command.add_argument("--model", type=Path, required=True)
    command.add_argument("--out", type=Path, help="Parquet of reconstructions", required=True)
    command.add_argument("--out-parameters", type=Path, help="JSON: errors of Table 1", required=True)
    command.add_argument("--out-cpu", type=Path, help="JSON: CPU time per building", required=True)
    command.add_argument("--threads", type=int, default=1)
    command.add_argument("--device", choices=DEVICES, default="auto")
    command = add_command(
        evaluate, "fit", eval_fit, "reconstruct the same buildings as p2wss reconstruct does"
    )
    command.add_argument("--manifest", type=Path, required=True)
    command.add_argument("--out", type=Path, help="Parquet of reconstructions", required=True)
    command.add_argument("--out-cpu", type=Path, help="JSON: CPU time per building", required=True)
    command.add_argument(
        "--model", type=Path, default=None, help="weights of the network; default: without a network"
    )
    command.add_argument("--threads", type=int, default=1)
    command.add_argument("--device", choices=DEVICES, default="auto")
    command = add_command(
        evaluate, "baseline", eval_baseline, "reconstruct the same buildings with a baseline"
    )
    command.add_argument("--name", help="lod1, constant or roofer", required=True)
    command.add_argument("--manifest", type=Path, required=True)
    command.add_argument("--out", type=Path, help="Parquet of reconstructions", required=True)
    command.add_argument("--out-cpu", type=Path, help="JSON: CPU time per building", required=True)
    command = add_command(
        evaluate, "measure", eval_measure, "Chamfer distance, triangles, .. of every reconstruction"
    )
    command.add_argument("--manifest", type=Path, required=True)
    command.add_argument("--out", type=Path, help="Parquet, one row per building and method", required=True)
    command.add_argument("--reconstructions", type=Path, nargs="+", required=True)
    command = add_command(evaluate, "ablation", eval_ablation, "the table of the ablation, on the test split")
    command.add_argument("--manifest", type=Path, required=True)
    command.add_argument("--out-csv", type=Path, required=True)
    command.add_argument("--out-markdown", type=Path, required=True)
    command.add_argument("--models", type=Path, nargs="+", help="VARIANT/model.safetensors", required=True)
    command.add_argument("--threads", type=int, default=1)
    command.add_argument("--device", choices=DEVICES, default="auto")
    command = add_command(evaluate, "report", eval_report, "the report")
    command.add_argument(
        "--out", type=Path, help="folder: report.html and its tables as CSV and LaTeX", required=True
    )
    command.add_argument("--manifest", type=Path, required=True)
    command.add_argument("--measures", type=Path, required=True)
    command.add_argument("--parameters", type=Path, required=True)
    command.add_argument("--reconstructions", type=Path, nargs="+", required=True)
    command.add_argument("--cpu", type=Path, nargs="*", default=[], help="JSON: CPU time per building")
    command.add_argument(
        "--metrics", type=Path, nargs="*", required=True, help="metrics.jsonl of dvae and model"
    )
    command.add_argument("--scans", type=Path, nargs="*", default=[], help="PNGs of simulated scans")


def eval_predict(arguments: argparse.Namespace) -> None:
    set_num_threads(arguments.threads)
    from p2wss.eval import cases, parameters, predict
    from p2wss.eval.clock import CpuClock
    from p2wss.nets.predictor import load_predictor
    from p2wss.reconstruct.product import NETWORK

    config, clock = read_config(arguments), CpuClock()
    predictor = load_predictor(arguments.model, arguments.device)
    manifest = cases.read_manifest(arguments.manifest)
    found = cases.test_cases(manifest)
    rows = predict.predict(found, predictor, config.reconstruct, clock)
    errors = parameters.masked_errors(found, rows, predictor, cases.train_medians(manifest))
    facts = _eval_facts(config, method=NETWORK, status="ok", model=_facts_of_weights(arguments.model))
    files.write_json(arguments.out_parameters, errors | {"p2wss": facts})
    _write_reconstructions(arguments, found, rows, facts, clock)


def eval_fit(arguments: argparse.Namespace) -> None:
    set_num_threads(arguments.threads)
    from p2wss.eval import cases, predict
    from p2wss.eval.clock import CpuClock
    from p2wss.nets.predictor import load_predictor
    from p2wss.reconstruct.product import FIT, NETWORK_AND_FIT

    config, clock = read_config(arguments), CpuClock()
    found = cases.test_cases(cases.read_manifest(arguments.manifest))
    facts: dict[str, Any] = {"method": FIT, "status": "ok"}
    predictor = None
    if arguments.model is not None:
        predictor = load_predictor(arguments.model, arguments.device)
        facts = {"method": NETWORK_AND_FIT, "status": "ok", "model": _facts_of_weights(arguments.model)}
    rows = predict.fit(found, predictor, config.reconstruct, clock)
    _write_reconstructions(arguments, found, rows, _eval_facts(config, **facts), clock)


def _facts_of_weights(path: Path) -> dict[str, Any]:
    from p2wss.nets.weights import read_weights

    facts = read_weights(path, "model")[1]
    return {name: facts[name] for name in ("version", "code", "config", "dvae_config")}


def eval_baseline(arguments: argparse.Namespace) -> None:
    from p2wss.eval import baselines, cases
    from p2wss.eval.clock import CpuClock

    config, clock = read_config(arguments), CpuClock()
    manifest = cases.read_manifest(arguments.manifest)
    found = cases.test_cases(manifest)
    made, run = baselines.baseline(arguments.name, found, manifest, config.eval, config.reconstruct, clock)
    chosen = [case for case in found if case.key in made]
    rows = [made[case.key] for case in chosen]
    log.info("%s: %s", arguments.name, run["status"])
    _write_reconstructions(arguments, chosen, rows, _eval_facts(config, method=arguments.name, **run), clock)


def _write_reconstructions(
    arguments: argparse.Namespace, found: Any, rows: Any, facts: dict[str, Any], clock: Any
) -> None:
    from p2wss.data.schemas.reconstructions import RECONSTRUCTIONS, reconstruction_columns

    columns = reconstruction_columns(rows, [case.dataset for case in found])
    files.write_table(arguments.out, columns, RECONSTRUCTIONS, facts)
    files.write_json(arguments.out_cpu, {"method": facts["method"], "cpu_ms": clock.ms_per_building()})
    log_status_counts(arguments.out, columns["status"])


def eval_measure(arguments: argparse.Namespace) -> None:
    from p2wss.data.schemas.measures import MEASURES
    from p2wss.data.schemas.reconstructions import read_reconstructions
    from p2wss.eval import cases, measure

    config = read_config(arguments)
    found = cases.test_cases(cases.read_manifest(arguments.manifest))
    methods = [read_reconstructions(path) for path in arguments.reconstructions]
    rows = cases.columns_of(measure.measure(found, methods, config.eval), MEASURES.names)
    files.write_table(arguments.out, rows, MEASURES, _eval_facts(config))
    log.info("%s: %d rows", arguments.out, len(rows["method"]))


def eval_ablation(arguments: argparse.Namespace) -> None:
    set_num_threads(arguments.threads)
    from p2wss.eval import ablation

    rows = ablation.measure(arguments.manifest, arguments.models, arguments.device)
    files.write_text(arguments.out_csv, ablation.csv(rows))
    files.write_text(arguments.out_markdown, ablation.markdown(rows))
    log.info("%s", ablation.markdown(rows))


def eval_report(arguments: argparse.Namespace) -> None:
    from p2wss.eval import attribution, report

    config = read_config(arguments)
    named = attribution.attribution(config, attribution.read(config.fetch.sources))
    footer = {"attribution": [*named, *config.eval.attribution]}
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
    made_by = section_json(config, "eval", "reconstruct")
    return files.provenance(config=made_by, code=fingerprint("eval"), **facts)
