"""Towns. In: nothing but a seed. Out: the footprints and the terrain of a made-up town, in IGN's file formats."""


rule draw_town:
    output:
        footprints="resources/towns/{seed}/bdtopo/BDTOPO_mini.gpkg",
        dtm=directory("resources/towns/{seed}/rgealti"),
    log:
        "logs/towns/{seed}.log",
    benchmark:
        "logs/towns/{seed}.tsv"
    wildcard_constraints:
        seed=r"\d+",
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=1000,
    params:
        code=fingerprint("towns"),
        folder=subpath(output.dtm, parent=True),
    shell:
        "p2wss towns --seed {wildcards.seed} --out {params.folder} 2> {log}"
