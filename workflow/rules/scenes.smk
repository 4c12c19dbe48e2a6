"""Scenes: cleaned buildings of a tile and its margin, with heights and roof angles.

In:  <results>/fetch/footprints.gpkg, <resources>/dtm/{tile}.tif.
Out: <results>/scenes/index.tsv (buildings per tile), <results>/scenes/{tile}.parquet, <results>/scenes/{tile}.tif
     (the terrain under the scene).
"""


checkpoint index_scenes:
    input:
        footprints="<results>/fetch/footprints.gpkg",
    output:
        index="<results>/scenes/index.tsv",
    log:
        "<logs>/scenes/index.log",
    benchmark:
        "<benchmarks>/scenes/index.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=2000,
    params:
        config=section("region", "scenes"),
        code=fingerprint("scenes"),
    shell:
        "p2wss scenes index --footprints {input.footprints} --out {output.index} --config {params.config:q} 2> {log}"


rule cut_scene:
    input:
        footprints="<results>/fetch/footprints.gpkg",
        dtm="<resources>/dtm/{tile}.tif",
    output:
        scene="<results>/scenes/{tile}.parquet",
        dtm="<results>/scenes/{tile}.tif",
    log:
        "<logs>/scenes/{tile}.log",
    benchmark:
        "<benchmarks>/scenes/{tile}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=2000,
    params:
        config=section("region", "scenes"),
        code=fingerprint("scenes"),
    shell:
        "p2wss scenes cut --tile {wildcards.tile} --footprints {input.footprints} --dtm {input.dtm} --out {output.scene}"
        " --out-dtm {output.dtm}"
        " --config {params.config:q} 2> {log}"


rule scenes:
    input:
        every_tile("<results>/scenes/{tile}.parquet"),
