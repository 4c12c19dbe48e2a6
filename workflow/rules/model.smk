"""Model: the network Point2WSS.

In:  the crops, <results>/dvae/model.safetensors.
Out: <results>/model/model.safetensors, <results>/model/metrics.jsonl; checkpoints beside them, declared by no rule.
"""


rule model:
    input:
        manifest="<results>/crops/manifest.json",
        simulated=simulated_shards,
        real=real_shards,
        dvae="<results>/dvae/model.safetensors",
        start=start_of(settings.model),
    output:
        weights="<results>/model/model.safetensors",
        metrics="<results>/model/metrics.jsonl",
    log:
        "<logs>/model/train.log",
    benchmark:
        "<benchmarks>/model/train.tsv"
    conda:
        "../../envs/p2wss.yaml"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 1440 * attempt,
    params:
        config=section("model", without=NOT_OF_TRAINING),
        code=fingerprint("training.model"),
        folder=subpath(output.weights, parent=True),
        program=program(settings.model),
    shell:
        "{params.program:q} model --manifest {input.manifest:q} --dvae {input.dvae:q} --out {output.weights:q} --out-metrics {output.metrics:q}"
        " --checkpoints {params.folder:q}/checkpoints"
        " --threads {threads} --config {params.config:q} 2>&1 | tee {log:q}"
