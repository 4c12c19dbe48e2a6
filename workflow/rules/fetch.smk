"""Fetch: footprints, terrain and LiDAR, from a service or from folders, in one form.

In:  what the section fetch of the config names: your files, each of which is tracked, or the town of rule draw_town.
Out: <results>/fetch/{place}footprints.gpkg, resources/ign/{vintage}/dtm/{tile}.tif, .../lidar/{tile}.laz as delivered,
     and <results>/fetch/lidar/{place}{tile}.laz with a class for the ground.

What a service sends is kept in resources/ign/{vintage}/downloads: these rules, run again, request
nothing that is there and whole.
"""

lidar_around = around("<results>/fetch/lidar/{place}{tile}.laz")
delivered_around = around("resources/ign/{vintage}/lidar/{tile}.laz")


# requests are sent from the machine that runs Snakemake: cluster nodes often have no internet
localrules:
    fetch_footprints,
    fetch_dtm,
    fetch_lidar,


rule fetch_footprints:
    input:
        source_files("footprints"),
    output:
        footprints="<results>/fetch/{place}footprints.gpkg",
    log:
        "<logs>/fetch/{place}footprints.log",
    benchmark:
        "<benchmarks>/fetch/{place}footprints.tsv"
    retries: 2
    conda:
        "../../envs/p2wss.yaml"
    resources:
        ign_requests=1,
        mem_mb=lambda wildcards, attempt: 1000 * attempt,
    params:
        config=section("region", "fetch", without=(*TILE_LISTS, *OF_CLOUDS, "prepare")),
        code=fingerprint("fetching"),
        downloads=lambda wildcards: f"resources/ign/{at(wildcards.place).region.vintage}/downloads",
        sizes=source_sizes("footprints"),
    shell:
        "p2wss fetch footprints --out {output.footprints:q} --downloads {params.downloads:q}"
        " --config {params.config:q} 2> {log:q}"


rule fetch_dtm:
    input:
        source_files("dtm", source_of_tile),
    output:
        dtm="resources/ign/{vintage}/dtm/{tile}.tif",
    log:
        "<logs>/fetch/{vintage}/dtm_{tile}.log",
    benchmark:
        "<benchmarks>/fetch/{vintage}/dtm_{tile}.tsv"
    retries: 2
    conda:
        "../../envs/p2wss.yaml"
    resources:
        ign_requests=1,
        mem_mb=lambda wildcards, attempt: 1000 * attempt,
    params:
        config=source_section,
        code=fingerprint("fetching"),
        downloads="resources/ign/{vintage}/downloads",
        sizes=source_sizes("dtm", source_of_tile),
    shell:
        "p2wss fetch dtm --tile {wildcards.tile:q} --out {output.dtm:q} --downloads {params.downloads:q}"
        " --config {params.config:q} 2> {log:q}"


rule fetch_lidar:
    input:
        source_files("lidar", source_of_tile),
    output:
        lidar="resources/ign/{vintage}/lidar/{tile}.laz",
    log:
        "<logs>/fetch/{vintage}/lidar_{tile}.log",
    benchmark:
        "<benchmarks>/fetch/{vintage}/lidar_{tile}.tsv"
    retries: 2
    conda:
        "../../envs/p2wss.yaml"
    resources:
        ign_requests=1,
        mem_mb=lambda wildcards, attempt: 1000 * attempt,
    params:
        config=source_section,
        code=fingerprint("fetching"),
        downloads="resources/ign/{vintage}/downloads",
        sizes=source_sizes("lidar", source_of_tile),
    shell:
        "p2wss fetch lidar --tile {wildcards.tile:q} --out {output.lidar:q} --downloads {params.downloads:q}"
        " --config {params.config:q} 2> {log:q}"


rule prepare_lidar:
    input:
        clouds=delivered_around,
        stages=lambda wildcards: local(at(wildcards.place).fetch.prepare.pdal_stages),
    output:
        lidar="<results>/fetch/lidar/{place}{tile}.laz",
    log:
        "<logs>/fetch/prepare/{place}{tile}.log",
    benchmark:
        "<benchmarks>/fetch/prepare/{place}{tile}.tsv"
    conda:
        "../../envs/pdal.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 8000 * attempt,
        runtime=lambda wildcards, attempt: 120 * attempt,
    params:
        config=section("region", "fetch", without=(*TILE_LISTS, "geoplateforme")),
        code=fingerprint("fetching"),
    shell:
        "p2wss fetch prepare --tile {wildcards.tile:q} --clouds {input.clouds:q} --out {output.lidar:q} --config {params.config:q} 2> {log:q}"


rule fetch:
    input:
        expand("<results>/fetch/{place}footprints.gpkg", place=MEMBERS),
        every_tile("resources/ign/{vintage}/dtm/{tile}.tif", draws=False),
        every_lidar_tile("<results>/fetch/lidar/{place}{tile}.laz"),
