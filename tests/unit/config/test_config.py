"""The config: generated files match the models, and each mistake gives one clear line."""

import json
import subprocess
import sys

import pytest
import yaml
from places import ROOT

from p2wss import config
from p2wss.config import Config, Section
from p2wss.config.generate import default_yaml
from p2wss.storage.messages import InputError


def test_generated_files_are_up_to_date():
    assert (ROOT / "config/default.yaml").read_text() == default_yaml(), "run `make config`"
    schema = json.loads((ROOT / "config/schema.json").read_text())
    assert schema == Config.model_json_schema(), "run `make config`"


def test_default_yaml_equals_the_defaults():
    assert config.load(ROOT / "config/default.yaml") == Config()


@pytest.mark.parametrize("file", sorted((ROOT / "config").glob("**/*.yaml")), ids=lambda path: path.name)
def test_every_config_is_valid(file):
    config.load(ROOT / "config/default.yaml", file)


def test_every_key_has_a_description():
    def keys(model):
        for name, field in model.model_fields.items():
            inner = field.annotation
            if isinstance(inner, type) and issubclass(inner, Section):
                yield from ((f"{name}.{key}", about) for key, about in keys(inner))
            else:
                yield name, field.description

    assert [key for key, about in keys(Config) if not about] == []


def test_sections_survive_a_round_trip_as_json():
    settings = config.load({"region": {"name": "elsewhere"}})
    text = config.section_json(settings, "region", "scans")
    assert "\n" not in text and config.load(text).region == settings.region


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"region": {"tile_sizem": 3}}, "region.tile_sizem: unknown key (did you mean tile_size_m?)"),
        ({"sans": {}}, "sans: unknown key (did you mean scans?)"),
        ({"region": {"tile_size_m": -1}}, "region.tile_size_m: Input should be greater than or equal to 10"),
        ({"region": {"bounds_m": [0, 0, 1e9, 1e9]}}, "bounds_m must be metres in the CRS of the region"),
        ({"region": {"bounds_m": [0, 0, 9e7, 9e7]}}, "bounds_m hold 8,100,000,000 tiles of tile_size_m 1000"),
        ({"region": {"bounds_m": [0, 0, float("nan"), 1]}}, "bounds_m"),
        ({"region": {"vintage": ".."}}, "region.vintage: String should match pattern"),
        ({"dvae": {"num_tokens": 10**11}}, "dvae.num_tokens: Input should be less than or equal to 65536"),
        ({"model": {"dim": 10**7}}, "model.dim: Input should be less than or equal to 4096"),
        ({"region": {"bounds_m": [1, 0, 0, 1]}}, "bounds_m must be x_min, y_min, x_max, y_max"),
        ("no/such.yaml", "no/such.yaml: no such file"),
        ("{region: [", "not YAML"),
    ],
)
def test_a_mistake_gives_one_line(document, message):
    with pytest.raises(InputError) as error:
        config.load(document)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_the_config_imports_nothing_heavy():
    """The Snakefile imports these modules, and every cluster job parses the Snakefile again."""
    code = "import sys, p2wss.config, p2wss.storage.provenance, p2wss.data.tiling; print(*sys.modules)"
    modules = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert not {"torch", "pandas", "geopandas", "pyarrow", "numba", "shapely", "yaml"} & set(modules)


def test_default_yaml_is_valid_yaml():
    parsed = yaml.safe_load(default_yaml())
    assert list(parsed) == list(Config.model_fields)
