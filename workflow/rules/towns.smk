"""Towns: made-up towns in IGN's file formats, to run and to train on.

In:  the seed, in the name of the folder.
Out: resources/towns/{seed}/bdtopo/BDTOPO_mini.gpkg (footprints) and resources/towns/{seed}/rgealti (terrain).
"""


# drawn where the rules of fetch, which read it, run
localrules:
    draw_town,


rule draw_town:
    output:
        footprints=local("resources/towns/{seed}/bdtopo/BDTOPO_mini.gpkg"),
        dtm=local(directory("resources/towns/{seed}/rgealti")),
    log:
        "logs/towns/{seed}.log",
    benchmark:
        "logs/towns/{seed}.tsv"
    wildcard_constraints:
        seed=r"\d+",
    conda:
        "../../envs/p2wss.yaml"
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
    params:
        code=fingerprint("towns"),
        folder=subpath(output.dtm, parent=True),
    shell:
        "p2wss towns --seed {wildcards.seed:q} --out {params.folder:q} 2> {log:q}"
