"""Crops. In: buildings and scans, or footprints and real LiDAR. Out: shards of building clouds and their manifest."""


rule crop_scene:
    input:
        buildings="<results>/buildings/{tile}.parquet",
        scan="<results>/scans/{tile}.laz",
    output:
        shard="<results>/crops/{tile}.parquet",
    log:
        "<logs>/crops/{tile}.log",
    benchmark:
        "<benchmarks>/crops/{tile}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
    params:
        config=section("crops"),
        code=fingerprint("crops"),
    shell:
        "p2wss crops scene --buildings {input.buildings} --scan {input.scan} --out {output.shard} --config {params.config:q} 2> {log}"


rule crop_lidar:
    input:
        footprints="<results>/fetch/footprints.gpkg",
        clouds=lidar_around,
    output:
        shard="<results>/crops_hd/{tile}.parquet",
    log:
        "<logs>/crops_hd/{tile}.log",
    benchmark:
        "<benchmarks>/crops_hd/{tile}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 8000 * attempt,
    params:
        config=section("region", "scenes", "crops"),
        code=fingerprint("crops", "data.footprints"),
    shell:
        "p2wss crops lidar --tile {wildcards.tile} --footprints {input.footprints} --clouds {input.clouds} --out {output.shard}"
        " --config {params.config:q} 2> {log}"


rule crops:
    input:
        index="<results>/scenes/index.tsv",
        scenes=every_tile("<results>/crops/{tile}.parquet"),
        lidar=expand("<results>/crops_hd/{tile}.parquet", tile=settings.region.lidar_tiles),
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
        "p2wss crops manifest --out {output.manifest} --scenes {input.scenes} --lidar {input.lidar}"
        " --config {params.config:q} 2> {log}"
