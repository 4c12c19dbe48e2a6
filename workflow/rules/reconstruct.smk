"""Reconstruct: buildings from real LiDAR, by the command that users type too.

In:  <results>/fetch/{place}footprints.gpkg, <results>/fetch/lidar/{place}{tile}.laz with its neighbours.
Out: <results>/reconstruct/{place}{tile} with the suffix of each of reconstruct.outputs, its wedges on request, and {tile}.json, a summary.
"""

from p2wss.config import OUTPUT_SUFFIXES, WEDGES_SUFFIX


rule reconstruct_tile:
    input:
        footprints="<results>/fetch/{place}footprints.gpkg",
        clouds=lidar_around,
    output:
        [
            f"<results>/reconstruct/{{place}}{{tile}}{OUTPUT_SUFFIXES[name]}"
            for name in settings.reconstruct.outputs
        ],
        [f"<results>/reconstruct/{{place}}{{tile}}{WEDGES_SUFFIX}"] if settings.reconstruct.wedges else [],
        summary="<results>/reconstruct/{place}{tile}.json",
    log:
        "<logs>/reconstruct/{place}{tile}.log",
    benchmark:
        "<benchmarks>/reconstruct/{place}{tile}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 4000 * attempt,
        runtime=lambda wildcards, attempt: 240 * attempt,
    params:
        config=section("region", "scenes", "reconstruct", without=TILE_LISTS),
        code=fingerprint("reconstruction", "formats.templates", "formats.assets", "weights"),
        folder=subpath(output.summary, parent=True),
    shell:
        "p2wss reconstruct {input.clouds:q} {input.footprints:q} {params.folder:q}"
        " --tile {wildcards.tile:q} --threads {threads} --config {params.config:q} 2> {log:q}"


rule reconstruct:
    input:
        every_lidar_tile("<results>/reconstruct/{place}{tile}.json"),
