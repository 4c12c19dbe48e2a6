"""Scans: a simulated LiDAR survey of a tile.

In:  <results>/scenes/{place}{tile}.parquet and {tile}.tif, <results>/buildings/{place}{tile}.parquet.
Out: <results>/scans/{place}{tile}.laz, {tile}.json (parameters and counts) and {tile}.png (a picture of a part).
"""


rule cast_scan:
    input:
        scene="<results>/scenes/{place}{tile}.parquet",
        dtm="<results>/scenes/{place}{tile}.tif",
        buildings="<results>/buildings/{place}{tile}.parquet",
    output:
        scan="<results>/scans/{place}{tile}.laz",
        survey="<results>/scans/{place}{tile}.json",
        picture="<results>/scans/{place}{tile}.png",
    log:
        "<logs>/scans/{place}{tile}.log",
    benchmark:
        "<benchmarks>/scans/{place}{tile}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 2500 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        config=section("scans"),
        code=fingerprint("scans"),
    shell:
        "p2wss scans --scene {input.scene:q} --dtm {input.dtm:q} --buildings {input.buildings:q} --out {output.scan:q}"
        " --out-survey {output.survey:q}"
        " --picture {output.picture:q} --threads {threads} --config {params.config:q} 2> {log:q}"


rule scans:
    input:
        every_tile("<results>/scans/{place}{tile}.laz"),
