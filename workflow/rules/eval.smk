"""Eval. In: crops, model, metrics. Out: reconstructions by every method, their measures, the report with its tables."""


rule predict:
    input:
        manifest="<results>/crops/manifest.json",
        shards=every_tile("<results>/crops/{tile}.parquet"),
        lidar=expand("<results>/crops_hd/{tile}.parquet", tile=settings.region.lidar_tiles),
        model="<results>/model/model.safetensors",
    output:
        predictions="<results>/eval/predictions.parquet",
        parameters="<results>/eval/parameters.json",
    log:
        "<logs>/eval/predict.log",
    benchmark:
        "<benchmarks>/eval/predict.tsv"
    conda:
        "../../envs/p2wss.yaml"
    threads: 2
    resources:
        mem_mb=8000,
        gpu=1,
    params:
        config=section("eval", "reconstruct"),
        code=fingerprint("eval.predict", "model"),
    shell:
        "p2wss eval predict {input.manifest} {input.model} {output.predictions} {output.parameters}"
        " --threads {threads} --config {params.config:q} 2> {log}"


rule baseline:
    input:
        manifest="<results>/crops/manifest.json",
        shards=every_tile("<results>/crops/{tile}.parquet"),
        lidar=expand("<results>/crops_hd/{tile}.parquet", tile=settings.region.lidar_tiles),
    output:
        reconstructions="<results>/eval/{baseline}.parquet",
    log:
        "<logs>/eval/{baseline}.log",
    benchmark:
        "<benchmarks>/eval/{baseline}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=4000,
    params:
        config=section("eval", "reconstruct"),
        code=fingerprint("eval.baselines"),
    shell:
        "p2wss eval baseline {wildcards.baseline} {input.manifest} {output.reconstructions}"
        " --config {params.config:q} 2> {log}"


rule measure:
    input:
        manifest="<results>/crops/manifest.json",
        shards=every_tile("<results>/crops/{tile}.parquet"),
        lidar=expand("<results>/crops_hd/{tile}.parquet", tile=settings.region.lidar_tiles),
        reconstructions=expand(
            "<results>/eval/{name}.parquet", name=["predictions", *settings.eval.baselines]
        ),
    output:
        measures="<results>/eval/measures.parquet",
    log:
        "<logs>/eval/measure.log",
    benchmark:
        "<benchmarks>/eval/measure.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=4000,
    params:
        config=section("eval"),
        code=fingerprint("eval.measure"),
    shell:
        "p2wss eval measure {input.manifest} {output.measures} {input.reconstructions}"
        " --config {params.config:q} 2> {log}"


rule eval_report:
    input:
        manifest="<results>/crops/manifest.json",
        measures="<results>/eval/measures.parquet",
        parameters="<results>/eval/parameters.json",
        reconstructions=rules.measure.input.reconstructions,
        metrics=["<results>/dvae/metrics.jsonl", "<results>/model/metrics.jsonl"],
        # pictures of the first few: a report of a whole city stays small
        scans=lambda wildcards: expand("<results>/scans/{tile}.png", tile=tiles(wildcards)[:3]),
        tables=expand("<results>/reconstruct/{tile}.gpkg", tile=settings.region.lidar_tiles),
        sources=settings.fetch.sources,
    output:
        report=report("<results>/eval/report.html", caption="../report/report.rst", category="Evaluation"),
        table1=report("<results>/eval/table1.csv", caption="../report/table1.rst", category="Evaluation"),
        table2=report("<results>/eval/table2.csv", caption="../report/table2.rst", category="Evaluation"),
    log:
        "<logs>/eval/report.log",
    benchmark:
        "<benchmarks>/eval/report.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=2000,
    params:
        config=section("region", "fetch", "eval"),
        code=fingerprint("eval.report", "eval.templates", "eval.assets"),
        folder=subpath(output.report, parent=True),
    shell:
        "p2wss eval report {params.folder} --manifest {input.manifest} --measures {input.measures}"
        " --parameters {input.parameters} --reconstructions {input.reconstructions} --metrics {input.metrics}"
        " --scans {input.scans}"
        " --config {params.config:q} 2> {log}"
