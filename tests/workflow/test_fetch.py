"""Fetch and prepare in the workflow: what is rerun when, and from what."""

from checkout import rules_to_run


def test_a_prepared_cloud_is_no_second_copy_and_does_not_depend_on_classes(project):
    project.snakemake("-c1", "fetch")
    prepared = project.folder / "results/mini/fetch/lidar/0653_6861.laz"
    assert prepared.samefile(project.folder / "resources/ign/mini/lidar/0653_6861.laz")
    changed = rules_to_run(project.dry_run("fetch", "--config", "region={classes: {preset: ahn}}"))
    assert changed == {}
