"""Ablation: what each switch of the model is worth; no part of the report.

In:  the crops, <results>/dvae/model.safetensors.
Out: <results>/ablation/{variant}/model.safetensors and metrics.jsonl for each of ablation.variants, and the table of
     their errors: <results>/ablation/table.csv.
"""


rule ablation_model:
    input:
        manifest="<results>/crops/manifest.json",
        simulated=simulated_shards,
        real=real_shards,
        dvae="<results>/dvae/model.safetensors",
        start=lambda wildcards: start_of(configs.ablated(settings, wildcards.variant).model),
    output:
        weights="<results>/ablation/{variant}/model.safetensors",
        metrics="<results>/ablation/{variant}/metrics.jsonl",
    log:
        "<logs>/ablation/{variant}.log",
    benchmark:
        "<benchmarks>/ablation/{variant}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 1440 * attempt,
    params:
        config=variant_section,
        code=fingerprint("training.model"),
        folder=subpath(output.weights, parent=True),
        program=program(settings.model),
    shell:
        "{params.program:q} model --manifest {input.manifest:q} --dvae {input.dvae:q} --out {output.weights:q} --out-metrics {output.metrics:q}"
        " --checkpoints {params.folder:q}/checkpoints"
        " --threads {threads} --config {params.config:q} 2>&1 | tee {log:q}"


rule ablation:
    input:
        manifest="<results>/crops/manifest.json",
        simulated=simulated_shards,
        real=real_shards,
        models=expand(
            "<results>/ablation/{variant}/model.safetensors", variant=list(settings.ablation.variants)
        ),
    output:
        table="<results>/ablation/table.csv",
    log:
        "<logs>/ablation/table.log",
    benchmark:
        "<benchmarks>/ablation/table.tsv"
    conda:
        "../../envs/p2wss.yaml"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 120 * attempt,
    params:
        config=section("ablation"),
        code=fingerprint("training.ablation"),
    shell:
        "p2wss eval ablation --manifest {input.manifest:q} --models {input.models:q} --out {output.table:q}"
        " --threads {threads} 2> {log:q}"
