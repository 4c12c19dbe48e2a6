"""The style with which QGIS opens the table of a run: what to check, in the colours and words of its page."""

from __future__ import annotations

_STATE = (
    "CASE WHEN status != 'ok' THEN status "
    "WHEN not_representable OR footprint_flags IS NOT NULL THEN 'flagged' ELSE 'ok' END"
)
# colour and words by state, as STATES of assets/viewer.js
STATES = {
    "ok": ("#7fa88b", "reconstructed"),
    "flagged": ("#d98e04", "to be checked"),
    "flat": ("#7b5ea7", "flat roof instead"),
    "none": ("#9aa4ab", "no mesh"),
}
_CATEGORY = '<category type="string" render="true" value="{}" label="{}" symbol="{}"/>'
_SYMBOL = (
    '<symbol type="fill" name="{}"><layer class="SimpleFill" enabled="1">'
    '<prop k="color" v="{}"/><prop k="outline_color" v="#404040"/><prop k="outline_width" v="0.1"/>'
    "</layer></symbol>"
)
_CATEGORIES = "".join(_CATEGORY.format(state, text, state) for state, (_, text) in STATES.items())
_SYMBOLS = "".join(_SYMBOL.format(state, color) for state, (color, _) in STATES.items())
# QML: a version, without which QGIS takes it for one of its first, and polygons, without which for points
STYLE = (
    '<!DOCTYPE qgis><qgis version="3.28.0" styleCategories="Symbology">'
    f'<renderer-v2 type="categorizedSymbol" attr="{_STATE}">'
    f"<categories>{_CATEGORIES}</categories><symbols>{_SYMBOLS}</symbols></renderer-v2>"
    "<layerGeometryType>2</layerGeometryType></qgis>"
)
