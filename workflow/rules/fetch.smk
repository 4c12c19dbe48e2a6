"""Fetch: footprints, terrain and LiDAR, from a service or from folders, in one form.

In:  what the section fetch of the config names; the town of rule draw_town, if it names one.
Out: <results>/fetch/footprints.gpkg, <resources>/dtm/{tile}.tif, <resources>/lidar/{tile}.laz as delivered, and
     <results>/fetch/lidar/{tile}.laz with a class for the ground.

What a service sends is kept in <resources>/downloads with a record of each request: these rules, run again, request
nothing that is there and whole.
"""

lidar_around = around("<results>/fetch/lidar/{tile}.laz")
delivered_around = around("<resources>/lidar/{tile}.laz")
downloads = f"resources/ign/{settings.region.vintage}/downloads"  # pathvars do not reach params


# requests are sent from the machine that runs Snakemake: cluster nodes often have no network
localrules:
    fetch_footprints,
    fetch_dtm,
    fetch_lidar,


rule fetch_footprints:
    input:
        drawn_town(settings.fetch.folder.footprints),
    output:
        footprints=ensure("<results>/fetch/footprints.gpkg", non_empty=True),
    log:
        "<logs>/fetch/footprints.log",
    benchmark:
        "<benchmarks>/fetch/footprints.tsv"
    retries: 2
    conda:
        "../../envs/p2wss.yaml"
    # a resource, because resources are not tracked: to go offline changes no result and reruns nothing
    resources:
        ign_requests=1,
        offline=int(settings.fetch.offline),
        mem_mb=2000,
    params:
        config=section("region", "fetch", without=("prepare", "sources", "offline")),
        code=fingerprint("fetch"),
        downloads=downloads,
    shell:
        "p2wss fetch footprints --out {output.footprints} --downloads {params.downloads} --offline {resources.offline}"
        " --config {params.config:q} 2> {log}"


rule fetch_dtm:
    input:
        drawn_town(settings.fetch.folder.dtm),
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
        offline=int(settings.fetch.offline),
        mem_mb=1000,
    params:
        config=section("region", "fetch", without=("prepare", "sources", "offline")),
        code=fingerprint("fetch"),
        downloads=downloads,
    shell:
        "p2wss fetch dtm --tile {wildcards.tile} --out {output.dtm} --downloads {params.downloads} --offline {resources.offline}"
        " --config {params.config:q} 2> {log}"


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
        offline=int(settings.fetch.offline),
        mem_mb=1000,
    params:
        config=section("region", "fetch", without=("prepare", "sources", "offline")),
        code=fingerprint("fetch"),
        downloads=downloads,
    shell:
        "p2wss fetch lidar --tile {wildcards.tile} --out {output.lidar} --downloads {params.downloads} --offline {resources.offline}"
        " --config {params.config:q} 2> {log}"


rule prepare_lidar:
    input:
        clouds=delivered_around,
        stages=settings.fetch.prepare.pdal_stages,
    output:
        lidar=ensure("<results>/fetch/lidar/{tile}.laz", non_empty=True),
    log:
        "<logs>/fetch/prepare_{tile}.log",
    benchmark:
        "<benchmarks>/fetch/prepare_{tile}.tsv"
    conda:
        "../../envs/pdal.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 8000 * attempt,
    params:
        config=section("region", "fetch", without=("geoplateforme", "sources", "offline")),
        code=fingerprint("fetch"),
    shell:
        "p2wss fetch prepare --tile {wildcards.tile} --clouds {input.clouds} --out {output.lidar} --config {params.config:q} 2> {log}"


rule fetch:
    input:
        rules.fetch_footprints.output,
        every_tile("<resources>/dtm/{tile}.tif"),
        expand("<results>/fetch/lidar/{tile}.laz", tile=settings.region.lidar_tiles),
