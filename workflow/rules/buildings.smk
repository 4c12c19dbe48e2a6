"""Buildings: a closed mesh of each building, or the reason why there is none.

In:  <results>/scenes/{place}{tile}.parquet.
Out: <results>/buildings/{place}{tile}.parquet.
"""


rule build_roofs:
    input:
        scene="<results>/scenes/{place}{tile}.parquet",
    output:
        buildings="<results>/buildings/{place}{tile}.parquet",
    log:
        "<logs>/buildings/{place}{tile}.log",
    benchmark:
        "<benchmarks>/buildings/{place}{tile}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        config=section("buildings"),
        code=fingerprint("scenes.buildings"),
    shell:
        "p2wss buildings --scene {input.scene:q} --out {output.buildings:q} --config {params.config:q} 2> {log:q}"


rule buildings:
    input:
        every_tile("<results>/buildings/{place}{tile}.parquet"),
