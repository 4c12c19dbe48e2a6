"""Scans: a simulated LiDAR survey of a tile.

In:  <results>/scenes/{tile}.parquet and {tile}.tif, <results>/buildings/{tile}.parquet.
Out: <results>/scans/{tile}.laz, {tile}.json (parameters and counts) and {tile}.png (a picture of a part).
"""


rule cast_scan:
    input:
        scene="<results>/scenes/{tile}.parquet",
        dtm="<results>/scenes/{tile}.tif",
        buildings="<results>/buildings/{tile}.parquet",
    output:
        scan=ensure("<results>/scans/{tile}.laz", non_empty=True),
        survey="<results>/scans/{tile}.json",
        picture="<results>/scans/{tile}.png",
    log:
        "<logs>/scans/{tile}.log",
    benchmark:
        "<benchmarks>/scans/{tile}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
    params:
        config=section("scans"),
        code=fingerprint("scans"),
    shell:
        "p2wss scans --scene {input.scene} --dtm {input.dtm} --buildings {input.buildings} --out {output.scan}"
        " --out-survey {output.survey}"
        " --picture {output.picture} --threads {threads} --config {params.config:q} 2> {log}"


rule scans:
    input:
        every_tile("<results>/scans/{tile}.laz"),
