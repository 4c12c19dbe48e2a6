"""``p2wss eval``: reconstruct the evaluation buildings, measure the errors, and write the report."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from p2wss.cli.common import (
    config_option,
    device_option,
    log,
    log_status_counts,
    manifest_option,
    threads_option,
)
from p2wss.cli.parser import Group, file_option, option
from p2wss.config import Config, DeviceName, measure_json, method_json
from p2wss.nets.threads import set_num_threads
from p2wss.storage import files
from p2wss.storage.provenance import fingerprint

_shards_option = file_option(
    "--shards", "evaluate only these shards of the manifest (default: all)", required=False, takes_list=True
)
_reconstructions_option = file_option(
    "--reconstructions", "files written by p2wss eval reconstruct", takes_list=True
)


@click.group(cls=Group)
def eval() -> None:
    """Evaluate the methods and write the report."""


@eval.command("medians")
@manifest_option
@file_option("--out", "JSON to write: the medians of the labels")
def eval_medians(manifest: Path, out: Path) -> None:
    """Compute the median height and angle that the constant baseline predicts."""
    from p2wss.data.manifest import read_manifest
    from p2wss.eval.cases import train_medians

    medians = train_medians(read_manifest(manifest))
    files.write_json(out, asdict(medians))
    log.info(f"{out.name}: {medians.eave_height_m:.3f} m, {medians.angle_deg:.1f} degrees")


@eval.command("reconstruct")
@option(
    "--method",
    required=True,
    help="point2wss, fit, masked (parameters for Table 1), lod1, constant or roofer",
)
@manifest_option
@_shards_option
@file_option("--model", "weights written by p2wss model (point2wss, masked)", required=False)
@file_option(
    "--medians",
    "JSON written by p2wss eval medians (constant; default: the medians of the shards that are evaluated)",
    required=False,
)
@file_option("--out", "Parquet to write: the reconstructions")
@threads_option
@device_option
@config_option
def eval_reconstruct(
    method: str, manifest: Path, shards: tuple[Path, ...], out: Path, config: Config, **options: Any
) -> None:
    """Reconstruct the test split and the real LiDAR by one method."""
    from p2wss.config import roofer_command
    from p2wss.data.manifest import read_manifest
    from p2wss.eval import cases, methods
    from p2wss.eval.cases import RECONSTRUCTIONS, reconstruction_columns

    listed = read_manifest(manifest, shards or None)
    inputs = methods.Inputs(config)
    facts: dict[str, Any] = {"method": method, "status": "ok"}
    if options["model"] is not None:  # torch, which takes seconds to import, is for these methods alone
        set_num_threads(options["threads"])
        from p2wss.nets.predictor import load_predictor
        from p2wss.nets.weights import read_weights

        inputs = inputs._replace(predictor=load_predictor(options["model"], options["device"]))
        of_weights = read_weights(options["model"], "model")[1]
        facts["model"] = {name: of_weights[name] for name in ("version", "code", "config", "dvae_config")}
    if method == "constant":
        stored = options["medians"]
        medians = (
            cases.train_medians(listed)
            if stored is None
            else files.read_json(stored, cases.Medians, "written by p2wss eval medians")
        )
        inputs = inputs._replace(medians=medians)
        facts["note"] = f"{medians.eave_height_m:.3f} m, {medians.angle_deg:.1f} degrees"
    status: list[str] = []
    with files.table_writer(out, RECONSTRUCTIONS) as writer:
        for of_shard in cases.test_cases(listed):
            dataset = of_shard[0].dataset
            rows = methods.reconstruct(method, of_shard, inputs._replace(crs=listed.crs.get(dataset)))
            writer.append(reconstruction_columns(rows, dataset))
            status += [row.status for row in rows]
        if method == "roofer":
            facts |= roofer_command.facts(config.eval, bool(status))
        writer.metadata = _facts(method_json(config, method), **facts)
    log_status_counts(out, status)


@eval.command("measure")
@manifest_option
@_shards_option
@_reconstructions_option
@file_option("--out", "Parquet to write: one row per building and method")
@config_option
def eval_measure(
    manifest: Path, shards: tuple[Path, ...], reconstructions: tuple[Path, ...], out: Path, config: Config
) -> None:
    """Measure the errors of all reconstructions."""
    from p2wss.data.manifest import read_manifest
    from p2wss.eval.cases import read_reconstructions, test_cases
    from p2wss.eval.measure import measure
    from p2wss.storage.schemas.measures import MEASURES

    num_rows, of_files = 0, [files.read_metadata(path) for path in reconstructions]
    with files.table_writer(out, MEASURES) as writer:
        for of_shard in test_cases(read_manifest(manifest, shards or None)):
            keys = [case.key for case in of_shard]
            for path in reconstructions:
                rows = list(measure(of_shard, read_reconstructions(path, keys), config))
                writer.append({name: [row[name] for row in rows] for name in MEASURES.names})
                num_rows += len(rows)
        of_methods = {str(facts["method"]): facts for facts in of_files}
        writer.metadata = _facts(measure_json(config), methods=of_methods)
    log.info("%s: %d rows", out, num_rows)


@eval.command("ablation")
@manifest_option
@file_option("--models", "weights of the variants: VARIANT/model.safetensors", takes_list=True)
@file_option("--out", "CSV to write: the table")
@threads_option
@device_option
def eval_ablation(
    manifest: Path, models: tuple[Path, ...], out: Path, threads: int, device: DeviceName
) -> None:
    """Compare the variants of the model."""
    set_num_threads(threads)
    from p2wss.training import ablation

    table = ablation.measure(manifest, models, device)
    files.write_text(out, table.to_csv(index=False, float_format="%.4f", lineterminator="\n"))
    log.info("%s\n%s", table.to_string(index=False), ablation.spreads(table).to_string())


@eval.command("report")
@manifest_option
@file_option("--measures", "files written by p2wss eval measure", takes_list=True)
@_reconstructions_option
@file_option("--metrics", "metrics written by p2wss dvae and p2wss model", required=False, takes_list=True)
@file_option("--scans", "images written by p2wss scans", required=False, takes_list=True)
@file_option("--out", "output folder: report.html, and its tables as CSV and LaTeX")
@config_option
def eval_report(manifest: Path, out: Path, config: Config, **inputs: tuple[Path, ...]) -> None:
    """Write the report."""
    from p2wss.eval import report

    for name, text in report.documents(report.read(config, manifest, **inputs)).items():
        files.write_text(out / name, text)
    log.info("%s", out / "report.html")


def _facts(settings: str, **facts: Any) -> dict[str, Any]:
    return files.provenance(config=settings, code=fingerprint("eval"), **facts)
