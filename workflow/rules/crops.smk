"""Crops: the points of each building, with labels where the scan is simulated.

In:  <results>/buildings/{tile}.parquet and <results>/scans/{tile}.laz; or <results>/fetch/footprints.gpkg and
     <results>/fetch/lidar/{tile}.laz.
Out: <results>/crops/simulated/{tile}.parquet, <results>/crops/real/{tile}.parquet, and
     <results>/crops/manifest.json, which lists both with hashes and splits.
"""

# what every later stage reads beside the manifest
simulated_shards = every_tile("<results>/crops/simulated/{tile}.parquet")
real_shards = expand("<results>/crops/real/{tile}.parquet", tile=settings.region.lidar_tiles)


rule crop_simulated:
    input:
        buildings="<results>/buildings/{tile}.parquet",
        scan="<results>/scans/{tile}.laz",
    output:
        shard="<results>/crops/simulated/{tile}.parquet",
    log:
        "<logs>/crops/simulated/{tile}.log",
    benchmark:
        "<benchmarks>/crops/simulated/{tile}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
    params:
        config=section("crops"),
        code=fingerprint("crops"),
    shell:
        "p2wss crops simulated --buildings {input.buildings} --scan {input.scan} --out {output.shard} --config {params.config:q} 2> {log}"


rule crop_real:
    input:
        footprints="<results>/fetch/footprints.gpkg",
        clouds=lidar_around,
    output:
        shard="<results>/crops/real/{tile}.parquet",
    log:
        "<logs>/crops/real/{tile}.log",
    benchmark:
        "<benchmarks>/crops/real/{tile}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 8000 * attempt,
    params:
        config=section("region", "scenes", "crops"),
        code=fingerprint("crops", "data.footprints"),
    shell:
        "p2wss crops real --tile {wildcards.tile} --footprints {input.footprints} --clouds {input.clouds} --out {output.shard}"
        " --config {params.config:q} 2> {log}"


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
        mem_mb=1000,
    params:
        config=section("crops"),
        code=fingerprint("crops"),
    shell:
        "p2wss crops manifest --out {output.manifest} --simulated {input.simulated} --real {input.real}"
        " --config {params.config:q} 2> {log}"
