"""Eval: reconstructions by every method, their measures, and the report with its tables.

In:  the crops, the weights of the model, the metrics of the trainings, pictures of the scans.
Out: <results>/eval/{method}.parquet and cpu/{method}.json for point2wss, point2wss+fit, fit and each of eval.baselines;
     parameters.json (errors of Table 1), measures.parquet; report.html and its tables as CSV and LaTeX.
"""

from shlex import quote

# our methods; each file of reconstructions is named after its method
OURS = ["point2wss", "point2wss+fit", "fit"]
TABLES = ["table1", "table2", "table2_more", "without_mesh", "groups", "calibration", "worst"]


rule predict:
    input:
        manifest="<results>/crops/manifest.json",
        simulated=simulated_shards,
        real=real_shards,
        model=weights,
    output:
        reconstructions="<results>/eval/point2wss.parquet",
        parameters="<results>/eval/parameters.json",
        cpu="<results>/eval/cpu/point2wss.json",
    log:
        "<logs>/eval/point2wss.log",
    benchmark:
        "<benchmarks>/eval/point2wss.tsv"
    conda:
        "../../envs/p2wss.yaml"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 3000 * attempt,
        gpu=1,
    params:
        config=section("eval", "reconstruct", without=REPORT_ONLY + ROOFER_ONLY),
        code=fingerprint("eval.predict", "eval.parameters", "nets.predictor"),
    shell:
        "p2wss eval predict --manifest {input.manifest} --model {input.model:q} --out {output.reconstructions}"
        " --out-parameters {output.parameters} --out-cpu {output.cpu}"
        " --threads {threads} --config {params.config:q} 2> {log}"


rule fit:
    input:
        manifest="<results>/crops/manifest.json",
        simulated=simulated_shards,
        real=real_shards,
        model=branch(lambda wildcards: wildcards.method == "point2wss+fit", then=weights, otherwise=[]),
    output:
        reconstructions="<results>/eval/{method}.parquet",
        cpu="<results>/eval/cpu/{method}.json",
    log:
        "<logs>/eval/{method}.log",
    benchmark:
        "<benchmarks>/eval/{method}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 3000 * attempt,
        gpu=lambda wildcards: int(wildcards.method == "point2wss+fit"),
    params:
        config=section("eval", "reconstruct", without=REPORT_ONLY + ROOFER_ONLY),
        code=fingerprint("eval.predict", "nets.predictor"),
        model=lambda wildcards, input: f"--model {quote(str(input.model))}" if input.model else "",
    shell:
        "p2wss eval fit --manifest {input.manifest} --out {output.reconstructions} --out-cpu {output.cpu} {params.model}"
        " --threads {threads} --config {params.config:q} 2> {log}"


rule baseline:
    input:
        manifest="<results>/crops/manifest.json",
        simulated=simulated_shards,
        real=real_shards,
        recorded=branch(lambda wildcards: wildcards.baseline == "roofer", then=RECORDED, otherwise=[]),
    output:
        reconstructions="<results>/eval/{baseline}.parquet",
        cpu="<results>/eval/cpu/{baseline}.json",
    log:
        "<logs>/eval/{baseline}.log",
    benchmark:
        "<benchmarks>/eval/{baseline}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
    params:
        config=baseline_section,
        code=fingerprint("eval.baselines"),
        state=baseline_state,
    shell:
        "p2wss eval baseline --name {wildcards.baseline} --manifest {input.manifest} --out {output.reconstructions}"
        " --out-cpu {output.cpu}"
        " --config {params.config:q} 2> {log}"


rule measure:
    input:
        manifest="<results>/crops/manifest.json",
        simulated=simulated_shards,
        real=real_shards,
        reconstructions=expand("<results>/eval/{name}.parquet", name=[*OURS, *settings.eval.baselines]),
    output:
        measures="<results>/eval/measures.parquet",
    log:
        "<logs>/eval/measure.log",
    benchmark:
        "<benchmarks>/eval/measure.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
    params:
        config=section("eval", without=REPORT_ONLY + ROOFER_ONLY),
        code=fingerprint("eval.measure"),
    shell:
        "p2wss eval measure --manifest {input.manifest} --reconstructions {input.reconstructions} --out {output.measures}"
        " --config {params.config:q} 2> {log}"


rule eval_report:
    input:
        manifest="<results>/crops/manifest.json",
        measures="<results>/eval/measures.parquet",
        parameters="<results>/eval/parameters.json",
        reconstructions=rules.measure.input.reconstructions,
        cpu=expand("<results>/eval/cpu/{name}.json", name=[*OURS, *settings.eval.baselines]),
        # weights from elsewhere have no metrics of a training here
        metrics=(
            []
            if settings.model.weights
            else ["<results>/dvae/metrics.jsonl", "<results>/model/metrics.jsonl"]
        ),
        # pictures of the first few: a report of a whole city stays small
        scans=lambda wildcards: every_tile("<results>/scans/{place}{tile}.png")(wildcards)[:3],
        tables=every_lidar_tile("<results>/reconstruct/{place}{tile}.json"),
        sources=local(settings.fetch.sources),
    output:
        report=report("<results>/eval/report.html", caption="../report/report.rst", category="Evaluation"),
        table1=report("<results>/eval/table1.csv", caption="../report/table1.rst", category="Evaluation"),
        table2=report("<results>/eval/table2.csv", caption="../report/table2.rst", category="Evaluation"),
        more=report(
            "<results>/eval/table2_more.csv", caption="../report/table2_more.rst", category="Evaluation"
        ),
        without_mesh=report(
            "<results>/eval/without_mesh.csv", caption="../report/without_mesh.rst", category="Evaluation"
        ),
        groups=report("<results>/eval/groups.csv", caption="../report/groups.rst", category="Evaluation"),
        calibration=report(
            "<results>/eval/calibration.csv", caption="../report/calibration.rst", category="Evaluation"
        ),
        worst=report("<results>/eval/worst.csv", caption="../report/worst.rst", category="Evaluation"),
        latex=expand("<results>/eval/{table}.tex", table=TABLES),
    log:
        "<logs>/eval/report.log",
    benchmark:
        "<benchmarks>/eval/report.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
    params:
        config=section("region", "fetch", "eval"),
        code=fingerprint("eval.report", "eval.templates", "eval.assets"),
        folder=subpath(output.report, parent=True),
    shell:
        "p2wss eval report --out {params.folder} --manifest {input.manifest} --measures {input.measures}"
        " --parameters {input.parameters} --reconstructions {input.reconstructions}"
        " --cpu {input.cpu} --metrics {input.metrics}"
        " --scans {input.scans}"
        " --config {params.config:q} 2> {log}"
