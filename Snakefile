"""p2wss: from footprints and LiDAR to watertight LoD2 buildings, and the tables of the paper Point2WSS.

One word per stage: fetch scenes buildings scans crops dvae model eval reconstruct. The same word names the
rule file, the section of the config, the folder of results and the target.
"""

from snakemake.utils import min_version

min_version("9.21.1")


configfile: "config/default.yaml"
configfile: "config/config.yaml"


include: "workflow/rules/common.smk"
include: "workflow/rules/places.smk"


pathvars:
    results=f"results/{configs.dataset_name(settings)}",
    logs=f"logs/{configs.dataset_name(settings)}",
    benchmarks=f"logs/{configs.dataset_name(settings)}/benchmarks",


include: "workflow/rules/towns.smk"
include: "workflow/rules/fetch.smk"
include: "workflow/rules/scenes.smk"
include: "workflow/rules/buildings.smk"
include: "workflow/rules/scans.smk"
include: "workflow/rules/crops.smk"
include: "workflow/rules/dvae.smk"
include: "workflow/rules/model.smk"
include: "workflow/rules/reconstruct.smk"
include: "workflow/rules/eval.smk"
include: "workflow/rules/ablation.smk"


onsuccess:
    cancel_timers()


onerror:
    cancel_timers()
    print_causes(log)


# without a target: every stage (the default target must stand in this file)
rule all:
    default_target: True
    input:
        rules.eval_report.output,
        every_lidar_tile("<results>/reconstruct/{place}{tile}.json"),
