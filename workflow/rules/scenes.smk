"""Scenes: cleaned buildings of a tile and its margin, with heights and roof angles.

In:  <results>/fetch/{place}footprints.gpkg, resources/ign/{vintage}/dtm/{tile}.tif.
Out: <results>/scenes/index.tsv (buildings per tile), <results>/scenes/{place}{tile}.parquet, <results>/scenes/{place}{tile}.tif
     (the terrain under the scene).
"""


checkpoint index_scenes:
    input:
        footprints=expand("<results>/fetch/{place}footprints.gpkg", place=MEMBERS),
    output:
        index="<results>/scenes/index.tsv",
    log:
        "<logs>/scenes/index.log",
    benchmark:
        "<benchmarks>/scenes/index.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 1000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        config=section("region", "dataset", "scenes", without=(*EVERY_TILE_LIST, *OF_CLOUDS)),
        code=fingerprint("scenes.cut"),
    shell:
        "p2wss scenes index --footprints {input.footprints:q} --out {output.index:q} --config {params.config:q} 2> {log:q}"


rule cut_scene:
    input:
        footprints=of_place("<results>/fetch/{member}footprints.gpkg"),
        dtm=of_place("resources/ign/{vintage}/dtm/{tile}.tif"),
    output:
        scene="<results>/scenes/{place}{tile}.parquet",
        dtm="<results>/scenes/{place}{tile}.tif",
    log:
        "<logs>/scenes/{place}{tile}.log",
    benchmark:
        "<benchmarks>/scenes/{place}{tile}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        config=section("region", "scenes", without=(*TILE_LISTS, *OF_CLOUDS)),
        code=fingerprint("scenes.cut"),
    shell:
        "p2wss scenes cut --tile {wildcards.tile:q} --place={wildcards.place:q} --footprints {input.footprints:q} --dtm {input.dtm:q} --out {output.scene:q}"
        " --out-dtm {output.dtm:q}"
        " --config {params.config:q} 2> {log:q}"


rule scenes:
    input:
        every_tile("<results>/scenes/{place}{tile}.parquet"),
