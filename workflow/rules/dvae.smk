"""Dvae: the discrete VAE that turns patches of points into tokens.

In:  the crops.
Out: <results>/dvae/model.safetensors, <results>/dvae/metrics.jsonl; checkpoints beside them, declared by no rule.
"""


rule dvae:
    input:
        manifest="<results>/crops/manifest.json",
        simulated=simulated_shards,
        real=real_shards,
    output:
        weights="<results>/dvae/model.safetensors",
        metrics="<results>/dvae/metrics.jsonl",
    log:
        "<logs>/dvae/train.log",
    benchmark:
        "<benchmarks>/dvae/train.tsv"
    conda:
        "../../envs/p2wss.yaml"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 1440 * attempt,
    params:
        config=section("dvae", without=RULE_ONLY),
        code=fingerprint("training.dvae"),
        folder=subpath(output.weights, parent=True),
        program=program(settings.dvae),
    shell:
        "{params.program:q} dvae --manifest {input.manifest:q} --out {output.weights:q} --out-metrics {output.metrics:q}"
        " --checkpoints {params.folder:q}/checkpoints"
        " --threads {threads} --config {params.config:q} 2>&1 | tee {log:q}"
