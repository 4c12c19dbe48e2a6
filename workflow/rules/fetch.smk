"""Fetch. In: nothing (a service or folders, by the config). Out: footprints, terrain, LiDAR in our own form."""


# a service is asked from the machine that runs Snakemake: cluster nodes often have no network
localrules:
    fetch_footprints,
    fetch_dtm,
    fetch_lidar,


rule fetch_footprints:
    output:
        footprints=ensure("<results>/fetch/footprints.gpkg", non_empty=True),
    log:
        "<logs>/fetch/footprints.log",
    benchmark:
        "<benchmarks>/fetch/footprints.tsv"
    retries: 2
    conda:
        "../../envs/p2wss.yaml"
    resources:
        ign_requests=1,
        mem_mb=2000,
    params:
        config=section("region", "fetch"),
        code=fingerprint("fetch"),
    shell:
        "p2wss fetch footprints {output.footprints} --config {params.config:q} 2> {log}"


rule fetch_dtm:
    output:
        dtm=ensure("<resources>/dtm/{tile}.tif", non_empty=True),
    log:
        "<logs>/fetch/dtm_{tile}.log",
    benchmark:
        "<benchmarks>/fetch/dtm_{tile}.tsv"
    retries: 2
    conda:
        "../../envs/p2wss.yaml"
    resources:
        ign_requests=1,
        mem_mb=1000,
    params:
        config=section("region", "fetch"),
        code=fingerprint("fetch"),
    shell:
        "p2wss fetch dtm {wildcards.tile} {output.dtm} --config {params.config:q} 2> {log}"


rule fetch_lidar:
    output:
        lidar=ensure("<resources>/lidar/{tile}.laz", non_empty=True),
    log:
        "<logs>/fetch/lidar_{tile}.log",
    benchmark:
        "<benchmarks>/fetch/lidar_{tile}.tsv"
    retries: 2
    conda:
        "../../envs/p2wss.yaml"
    resources:
        ign_requests=1,
        mem_mb=1000,
    params:
        config=section("region", "fetch"),
        code=fingerprint("fetch"),
    shell:
        "p2wss fetch lidar {wildcards.tile} {output.lidar} --config {params.config:q} 2> {log}"


rule fetch:
    input:
        rules.fetch_footprints.output,
        every_tile("<resources>/dtm/{tile}.tif"),
        expand("<resources>/lidar/{tile}.laz", tile=settings.region.lidar_tiles),
