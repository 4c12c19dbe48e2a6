"""Crops: the points of each building, with labels where the scan is simulated.

In:  <results>/buildings/{place}{tile}.parquet and <results>/scans/{place}{tile}.laz; or <results>/fetch/{place}footprints.gpkg and
     <results>/fetch/lidar/{place}{tile}.laz.
Out: <results>/crops/simulated/{place}{tile}.parquet, <results>/crops/real/{place}{tile}.parquet, and
     <results>/crops/manifest.json, which lists both with hashes and splits.
"""

# what every later stage reads beside the manifest
simulated_shards = every_tile("<results>/crops/simulated/{place}{tile}.parquet")
real_shards = every_lidar_tile("<results>/crops/real/{place}{tile}.parquet")


rule crop_simulated:
    input:
        buildings="<results>/buildings/{place}{tile}.parquet",
        scan="<results>/scans/{place}{tile}.laz",
    output:
        shard="<results>/crops/simulated/{place}{tile}.parquet",
    log:
        "<logs>/crops/simulated/{place}{tile}.log",
    benchmark:
        "<benchmarks>/crops/simulated/{place}{tile}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 2000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        config=section("crops"),
        code=fingerprint("crops"),
    shell:
        "p2wss crops simulated --buildings {input.buildings:q} --scan {input.scan:q} --out {output.shard:q} --config {params.config:q} 2> {log:q}"


rule crop_real:
    input:
        footprints="<results>/fetch/{place}footprints.gpkg",
        clouds=lidar_around,
    output:
        shard="<results>/crops/real/{place}{tile}.parquet",
    log:
        "<logs>/crops/real/{place}{tile}.log",
    benchmark:
        "<benchmarks>/crops/real/{place}{tile}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        config=section("region", "scenes", "crops", without=TILE_LISTS),
        code=fingerprint("crops", "footprints.cleaning"),
    shell:
        "p2wss crops real --tile {wildcards.tile:q} --place={wildcards.place:q} --footprints {input.footprints:q} --clouds {input.clouds:q} --out {output.shard:q}"
        " --config {params.config:q} 2> {log:q}"


rule crops:
    input:
        index="<results>/scenes/index.tsv",
        simulated=simulated_shards,
        real=real_shards,
    output:
        manifest="<results>/crops/manifest.json",
    log:
        "<logs>/crops/manifest.log",
    benchmark:
        "<benchmarks>/crops/manifest.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 1000 * attempt,
        runtime=lambda wildcards, attempt: 60 * attempt,
    params:
        config=section("dataset", "crops", without=("members",)),
        code=fingerprint("crops"),
    shell:
        "p2wss crops manifest --out {output.manifest:q} --simulated @<(printf '%s\\n' {input.simulated:q})"
        " --real @<(printf '%s\\n' {input.real:q})"
        " --config {params.config:q} 2> {log:q}"
