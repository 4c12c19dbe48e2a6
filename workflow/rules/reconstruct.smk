"""Reconstruct. In: footprints, real LiDAR, the model. Out: per LiDAR tile CityJSON, GLB and a table of buildings."""


rule reconstruct_tile:
    input:
        footprints="<results>/fetch/footprints.gpkg",
        clouds=lidar_around,
        model="<results>/model/model.safetensors",
    output:
        cityjson="<results>/reconstruct/{tile}.city.jsonl",
        glb="<results>/reconstruct/{tile}.glb",
        table="<results>/reconstruct/{tile}.gpkg",
    log:
        "<logs>/reconstruct/{tile}.log",
    benchmark:
        "<benchmarks>/reconstruct/{tile}.tsv"
    conda:
        "../../envs/p2wss.yaml"
    threads: 2
    resources:
        mem_mb=lambda wildcards, attempt: 8000 * attempt,
    params:
        config=section("region", "scenes", "crops", "reconstruct"),
        code=fingerprint("reconstruct", "model"),
        folder=subpath(output.cityjson, parent=True),
    shell:
        "p2wss reconstruct {input.clouds} {input.footprints} {params.folder} --model {input.model}"
        " --tile {wildcards.tile} --threads {threads} --config {params.config:q} 2> {log}"


rule reconstruct:
    input:
        expand("<results>/reconstruct/{tile}.city.jsonl", tile=settings.region.lidar_tiles),
