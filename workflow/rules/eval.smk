"""Eval: reconstructions by every method, their measures, and the report with its tables.

In:  the crops, the weights of the model, the metrics of the trainings, pictures of the scans.
Out: <results>/eval/parts/{group}/ per group of eval.shards_per_job shards: {method}.parquet and cpu/{method}.json for
     point2wss, point2wss+fit, fit and each of eval.baselines; measures.parquet and the errors of Table 1.
     <results>/eval/: medians.json (constant predictor); merged measures.parquet, parameters.json (errors of Table 1) and
     methods.json (status, CPU time); report.html and its tables as CSV and LaTeX.
"""

# our methods; each file of reconstructions is named after its method
OURS = ["point2wss", "point2wss+fit", "fit"]
METHODS = [*OURS, *settings.eval.baselines]
TABLES = ["table1", "table2", "table2_more", "without_mesh", "groups", "calibration", "worst"]


RECONSTRUCTIONS = every_group(expand("<results>/eval/parts/{{group}}/{name}.parquet", name=METHODS))


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
    params:
        code=fingerprint("eval.cases"),
    shell:
        "p2wss eval medians --manifest {input.manifest:q} --out {output.medians:q} 2> {log:q}"


rule predict:
    input:
        manifest="<results>/crops/manifest.json",
        shards=shards_of_group,
        medians="<results>/eval/medians.json",
        model=weights,
    output:
        reconstructions="<results>/eval/parts/{group}/point2wss.parquet",
        errors="<results>/eval/parts/{group}/masked_errors.json",
        cpu="<results>/eval/parts/{group}/cpu/point2wss.json",
    log:
        "<logs>/eval/{group}/point2wss.log",
    benchmark:
        "<benchmarks>/eval/{group}/point2wss.tsv"
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
        "p2wss eval predict --manifest {input.manifest:q} --shards {input.shards:q} --model {input.model:q} --medians {input.medians:q}"
        " --out {output.reconstructions:q} --out-errors {output.errors:q} --out-cpu {output.cpu:q}"
        " --threads {threads} --config {params.config:q} 2> {log:q}"


rule fit:
    input:
        manifest="<results>/crops/manifest.json",
        shards=shards_of_group,
        model=branch(lambda wildcards: wildcards.method == "point2wss+fit", then=weights, otherwise=[]),
    output:
        reconstructions="<results>/eval/parts/{group}/{method}.parquet",
        cpu="<results>/eval/parts/{group}/cpu/{method}.json",
    log:
        "<logs>/eval/{group}/{method}.log",
    benchmark:
        "<benchmarks>/eval/{group}/{method}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 3000 * attempt,
        gpu=lambda wildcards: int(wildcards.method == "point2wss+fit"),
    params:
        config=section("eval", "reconstruct", without=REPORT_ONLY + ROOFER_ONLY),
        code=fingerprint("eval.predict", "nets.predictor"),
        model=lambda wildcards, input: ["--model", input.model] if input.model else [],
    shell:
        "p2wss eval fit --manifest {input.manifest:q} --shards {input.shards:q} --out {output.reconstructions:q} --out-cpu {output.cpu:q} {params.model:q}"
        " --threads {threads} --config {params.config:q} 2> {log:q}"


# outputs of an earlier run of Roofer (eval.roofer_recorded), for all groups
rule recording:
    input:
        manifest="<results>/crops/manifest.json",
        real=real_shards,
        recorded=RECORDED,
    output:
        recording="<results>/eval/recording.parquet",
    log:
        "<logs>/eval/recording.log",
    benchmark:
        "<benchmarks>/eval/recording.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
    params:
        code=fingerprint("eval.recording"),
    shell:
        "p2wss eval recording --manifest {input.manifest:q} --recorded @<(printf '%s\\n' {input.recorded:q})"
        " --out {output.recording:q} 2> {log:q}"


rule baseline:
    input:
        manifest="<results>/crops/manifest.json",
        shards=shards_of_group,
        medians=branch(
            lambda wildcards: wildcards.baseline == "constant",
            then="<results>/eval/medians.json",
            otherwise=[],
        ),
        recording=branch(
            lambda wildcards: bool(RECORDED) and wildcards.baseline == "roofer",
            then="<results>/eval/recording.parquet",
            otherwise=[],
        ),
    output:
        reconstructions="<results>/eval/parts/{group}/{baseline}.parquet",
        cpu="<results>/eval/parts/{group}/cpu/{baseline}.json",
    log:
        "<logs>/eval/{group}/{baseline}.log",
    benchmark:
        "<benchmarks>/eval/{group}/{baseline}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
    params:
        config=baseline_section,
        code=fingerprint("eval.baselines"),
        state=baseline_state,
        medians=lambda wildcards, input: ["--medians", input.medians] if input.medians else [],
        recording=lambda wildcards, input: ["--recording", input.recording] if input.recording else [],
    shell:
        "p2wss eval baseline --name {wildcards.baseline:q} --manifest {input.manifest:q} --shards {input.shards:q} {params.medians:q}"
        " {params.recording:q} --out {output.reconstructions:q} --out-cpu {output.cpu:q}"
        " --config {params.config:q} 2> {log:q}"


rule measure:
    input:
        manifest="<results>/crops/manifest.json",
        shards=shards_of_group,
        reconstructions=expand("<results>/eval/parts/{{group}}/{name}.parquet", name=METHODS),
    output:
        measures="<results>/eval/parts/{group}/measures.parquet",
        errors="<results>/eval/parts/{group}/variant_errors.json",
    log:
        "<logs>/eval/{group}/measure.log",
    benchmark:
        "<benchmarks>/eval/{group}/measure.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
    params:
        config=section("eval", without=REPORT_ONLY + ROOFER_ONLY),
        code=fingerprint("eval.measure"),
    shell:
        "p2wss eval measure --manifest {input.manifest:q} --shards {input.shards:q} --reconstructions {input.reconstructions:q}"
        " --out {output.measures:q} --out-errors {output.errors:q}"
        " --config {params.config:q} 2> {log:q}"


rule merge:
    input:
        measures=every_group("<results>/eval/parts/{group}/measures.parquet"),
        variant_errors=every_group("<results>/eval/parts/{group}/variant_errors.json"),
        masked_errors=every_group("<results>/eval/parts/{group}/masked_errors.json"),
        reconstructions=RECONSTRUCTIONS,
        cpu=every_group(expand("<results>/eval/parts/{{group}}/cpu/{name}.json", name=METHODS)),
    output:
        measures="<results>/eval/measures.parquet",
        parameters="<results>/eval/parameters.json",
        methods="<results>/eval/methods.json",
    log:
        "<logs>/eval/merge.log",
    benchmark:
        "<benchmarks>/eval/merge.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 1000 * attempt,
    params:
        config=section("eval", "reconstruct", without=REPORT_ONLY + ROOFER_ONLY),
        code=fingerprint("eval.parts"),
        parts=folders_of("measures"),
        methods=METHODS,
    shell:
        "p2wss eval merge --parts @<(printf '%s\\n' {params.parts:q}) --methods {params.methods:q} --out-measures {output.measures:q}"
        " --out-parameters {output.parameters:q} --out-methods {output.methods:q}"
        " --config {params.config:q} 2> {log:q}"


rule eval_report:
    input:
        manifest="<results>/crops/manifest.json",
        measures="<results>/eval/measures.parquet",
        parameters="<results>/eval/parameters.json",
        methods="<results>/eval/methods.json",
        # of the buildings that it shows
        simulated=simulated_shards,
        real=real_shards,
        reconstructions=RECONSTRUCTIONS,
        # weights from elsewhere have no metrics of a training here
        metrics=(
            []
            if settings.model.weights
            else ["<results>/dvae/metrics.jsonl", "<results>/model/metrics.jsonl"]
        ),
        # pictures of the first few: a report of a whole city stays small
        scans=lambda wildcards: every_tile("<results>/scans/{place}{tile}.png")(wildcards)[:3],
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
        config=section("region", "dataset", "fetch", "eval", without=("shards_per_job",)),
        code=fingerprint("eval.report", "eval.templates", "eval.assets"),
        parts=folders_of("reconstructions"),
        folder=subpath(output.report, parent=True),
    shell:
        "p2wss eval report --out {params.folder:q} --manifest {input.manifest:q} --measures {input.measures:q}"
        " --parameters {input.parameters:q} --methods {input.methods:q} --parts @<(printf '%s\\n' {params.parts:q})"
        " --metrics {input.metrics:q} --scans {input.scans:q}"
        " --config @<(printf '%s\\n' {params.config:q}) 2> {log:q}"
