"""Eval: reconstructions by every method, their measures, and the report with its tables.

In:  the crops, the weights of the model, the metrics of the trainings, pictures of the scans.
Out: <results>/eval/medians.json (constant predictor); <results>/eval/parts/{group}/ per group of eval.shards_per_job
     shards: {method}.parquet for point2wss, fit, masked (parameters with the footprint hidden, for Table 1)
     and each of eval.baselines; measures.parquet. <results>/eval/: report.html and its tables as CSV and LaTeX.
"""

WITH_NETWORK = ["point2wss", "masked"]
METHODS = [*WITH_NETWORK, "fit", *settings.eval.baselines]
TABLES = ["table1", "table2", "table2_more", "without_mesh", "groups", "worst"]


# the constant predictor
rule medians:
    input:
        manifest="<results>/crops/manifest.json",
        simulated=simulated_shards,
        real=real_shards,
    output:
        medians="<results>/eval/medians.json",
    log:
        "<logs>/eval/medians.log",
    benchmark:
        "<benchmarks>/eval/medians.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 1000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        code=fingerprint("eval.cases"),
    shell:
        "p2wss eval medians --manifest {input.manifest:q} --out {output.medians:q} 2> {log:q}"


rule eval_reconstruct:
    input:
        manifest="<results>/crops/manifest.json",
        shards=shards_of_group,
        model=branch(lambda wildcards: wildcards.method in WITH_NETWORK, then=weights, otherwise=[]),
        medians=branch(
            lambda wildcards: wildcards.method == "constant",
            then="<results>/eval/medians.json",
            otherwise=[],
        ),
        # outputs of an earlier run of Roofer (eval.roofer_recorded)
        recorded=branch(lambda wildcards: wildcards.method == "roofer", then=RECORDED, otherwise=[]),
    output:
        reconstructions="<results>/eval/parts/{group}/{method}.parquet",
    log:
        "<logs>/eval/{group}/{method}.log",
    benchmark:
        "<benchmarks>/eval/{group}/{method}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 3000 * attempt,
        runtime=lambda wildcards, attempt: 480 * attempt,
    params:
        config=lambda wildcards: configs.method_json(settings, wildcards.method),
        code=fingerprint("eval.methods", "nets.predictor", "weights"),
        state=roofer_state,
        model=lambda wildcards, input: ["--model", input.model] if input.model else [],
        medians=lambda wildcards, input: ["--medians", input.medians] if input.medians else [],
    shell:
        "p2wss eval reconstruct --method {wildcards.method:q} --manifest {input.manifest:q} --shards {input.shards:q} {params.model:q}"
        " {params.medians:q} --out {output.reconstructions:q} --threads {threads} --config {params.config:q} 2> {log:q}"


rule measure:
    input:
        manifest="<results>/crops/manifest.json",
        shards=shards_of_group,
        reconstructions=expand("<results>/eval/parts/{{group}}/{name}.parquet", name=METHODS),
    output:
        measures="<results>/eval/parts/{group}/measures.parquet",
    log:
        "<logs>/eval/{group}/measure.log",
    benchmark:
        "<benchmarks>/eval/{group}/measure.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=lambda wildcards, attempt: 240 * attempt,
    params:
        config=lambda wildcards: configs.measure_json(settings),
        code=fingerprint("eval.measure"),
    shell:
        "p2wss eval measure --manifest {input.manifest:q} --shards {input.shards:q} --reconstructions {input.reconstructions:q}"
        " --out {output.measures:q} --config {params.config:q} 2> {log:q}"


rule eval_report:
    input:
        manifest="<results>/crops/manifest.json",
        measures=every_group("<results>/eval/parts/{group}/measures.parquet"),
        # of the buildings that it shows
        simulated=simulated_shards,
        real=real_shards,
        reconstructions=every_group(expand("<results>/eval/parts/{{group}}/{name}.parquet", name=METHODS)),
        # weights from elsewhere have no metrics of a training here
        metrics=(
            []
            if settings.model.weights
            else ["<results>/dvae/metrics.jsonl", "<results>/model/metrics.jsonl"]
        ),
        # pictures of the first few: a report of a whole city stays small
        scans=lambda wildcards: every_tile("<results>/scans/{place}{tile}.png")(wildcards)[:3],
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
        runtime=lambda wildcards, attempt: 120 * attempt,
    params:
        config=section("region", "dataset", "fetch", "eval", "reconstruct", without=("shards_per_job",)),
        code=fingerprint("eval.report", "eval.templates", "formats.templates", "formats.assets"),
        folder=subpath(output.report, parent=True),
    shell:
        "p2wss eval report --out {params.folder:q} --manifest {input.manifest:q} --measures @<(printf '%s\\n' {input.measures:q})"
        " --reconstructions @<(printf '%s\\n' {input.reconstructions:q}) --metrics {input.metrics:q} --scans {input.scans:q}"
        " --config @<(printf '%s\\n' {params.config:q}) 2> {log:q}"
