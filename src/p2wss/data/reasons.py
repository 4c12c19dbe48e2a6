"""Every status and reason of a building: a building is "ok", or has the reason why something is missing.

These are the values of the columns ``status`` and ``reason`` of all files, and the keys of counts of excluded
buildings. The reasons of the kernel are in :class:`p2wss.skeleton.Status`.
"""

OK = "ok"

# footprints and scenes
EMPTY = "empty"
NOT_A_POLYGON = "not-a-polygon"
NON_FINITE = "non-finite"
IMPLAUSIBLE_SIZE = "implausible-size"
TOO_MANY_CROSSINGS = "too-many-crossings"
TOO_MANY_EDGES = "too-many-edges"
TOO_SMALL = "too-small"
HAS_PARTS = "has-parts"
DUPLICATE = "duplicate"
WITHIN_OTHER = "within-other"
AROUND_OTHERS = "around-others"
NO_TERRAIN = "no-terrain"
TOO_HIGH = "too-high"

# crops and training data
TOO_LARGE = "too-large"
TOO_FEW_POINTS = "too-few-points"
NO_GROUND = "no-ground"
NO_LABELS = "no-labels"
HAS_COURTYARDS = "has-courtyards"
TOO_MANY_VERTICES = "too-many-vertices"
HEIGHT_OUT_OF_RANGE = "height-out-of-range"
FOOTPRINT_TOO_LARGE = "footprint-too-large"

# reconstructions
NO_POINTS = "no-points"
NO_POINTS_ON_BUILDING = "no-points-on-building"
TOO_FEW_ROOF_POINTS = "too-few-roof-points"
NO_HEIGHT = "no-height"
HEIGHT_FROM_ATTRIBUTE = "height-from-attribute"
NO_ROOF = "no-roof"
INVALID_SOLID = "invalid-solid"
SIMPLIFIED = "simplified-by-size"
INTERNAL_ERROR = "internal-error"
ROOFER_FAILED = "roofer-failed"
ROOFER_TIMEOUT = "roofer-timeout"
NO_ROOFER_MESH = "no-roofer-mesh"
NOT_RECORDED = "not-recorded"
OTHER_CLOUDS = "recorded-of-other-clouds"
OTHER_POINTS = "recorded-of-other-points"

# of buildings that no point shows
UNSEEN = (NO_POINTS, NO_POINTS_ON_BUILDING, NO_GROUND, HEIGHT_FROM_ATTRIBUTE)

# footprints that the cloud contradicts
NO_BUILDING = "no-building"
PARTLY_DEMOLISHED = "partly-demolished"
EXTENDED = "extended"
BEYOND_POINTS = "beyond-points"
RAISED_GROUND = "raised-ground"
# outlines of p2wss itself
LIKE_TREES = "like-trees"

FLAGS: dict[str, str] = {
    NO_BUILDING: "the area inside the footprint is ground",
    PARTLY_DEMOLISHED: "a contiguous area inside the footprint is ground: a demolished part, or a courtyard",
    EXTENDED: "a contiguous area beside the footprint and outside all footprints is roof: an extension, or a neighbour",
    BEYOND_POINTS: "a part of the footprint is far from all points, or most has none, as beyond the border of a cloud: "
    "a guess",
    RAISED_GROUND: "what p2wss takes for ground, in a cloud without classes, ends in walls of 3 m or more around the "
    "footprint, as a podium or a roof wider than 60 m does: the building may begin below it",
    LIKE_TREES: "an outline of a cloud without class 6 with less than 80 % of its points within 20 cm of the roof, as "
    "crowns of trees have",
}

MEANINGS: dict[str, str] = {
    OK: "nothing is missing",
    EMPTY: "the footprint has no area: no ring, or fewer than three vertices",
    NOT_A_POLYGON: "the geometry is a point or a line",
    NON_FINITE: "a coordinate is NaN or infinite",
    IMPLAUSIBLE_SIZE: "the geometry is longer than 5 km",
    TOO_MANY_CROSSINGS: "the rings of the geometry cross about 10,000 times or more",
    HAS_PARTS: "the footprint is the outline of others, its parts, which are built in its place",
    DUPLICATE: "another footprint covers nearly the same place, and is built",
    WITHIN_OTHER: "the footprint lies in others, with which it is built",
    AROUND_OTHERS: "the footprint is larger than any building, 0.5 km2, and has others in it, as the border of a map",
    NO_TERRAIN: "the terrain model has too few heights along the footprint (scenes.min_terrain_share)",
    TOO_HIGH: "the eave is higher than scenes.max_eave_height_m",
    TOO_LARGE: "the footprint reaches further than 320 m from its centre, beyond the number format of crops",
    TOO_FEW_POINTS: "fewer points than crops.min_points or, of a reconstruction, reconstruct.min_num_points",
    NO_GROUND: "the ground is unknown, also of a building whose footprint states a height (--terrain tells it)",
    NO_LABELS: "the labels of training are missing",
    HAS_COURTYARDS: "the footprint has courtyards, which a token sequence cannot represent",
    TOO_MANY_VERTICES: "the footprint has more vertices than model.max_vertices",
    HEIGHT_OUT_OF_RANGE: "the eave height is not in the range of the network's tokens",
    FOOTPRINT_TOO_LARGE: "the footprint is larger than the range of the network's tokens",
    NO_POINTS: "no point within reconstruct.buffer_m of the footprint",
    NO_POINTS_ON_BUILDING: "there are points, but none is on the building",
    TOO_FEW_ROOF_POINTS: "fewer than three points on the roof",
    NO_HEIGHT: "the method has no height for the building",
    HEIGHT_FROM_ATTRIBUTE: "no point shows the building: a flat roof at the height that its footprint states",
    NO_ROOF: "the fit found no roof for the points",
    INVALID_SOLID: "the solid violates a rule of ISO 19107, and so do simpler solids with a fitted roof",
    SIMPLIFIED: "the points show more planes than the fit of one building takes; the mesh has the largest",
    INTERNAL_ERROR: "the code failed at this building, or its process was killed; the log of errors has the traceback",
    ROOFER_FAILED: "Roofer ended with an error; see the log",
    ROOFER_TIMEOUT: "Roofer took longer than eval.roofer_timeout_s",
    NO_ROOFER_MESH: "Roofer produced no mesh",
    NOT_RECORDED: "the building is not among the recorded outputs of Roofer",
    OTHER_CLOUDS: "the recorded outputs of Roofer were made from other points than those of the tile now",
    OTHER_POINTS: "the recorded mesh of Roofer is of the same simulated building, from as many other points",
    # of the kernel, in the order of its checks
    TOO_SMALL: "the footprint is smaller than scenes.min_area_m2",
    TOO_MANY_EDGES: "the footprint has more edges than scenes.max_edges, or a ring has more than the kernel supports",
    "not-simple": "a ring of the footprint crosses or touches itself or another ring",
    "courtyard-outside": "a courtyard is outside the exterior, or inside another courtyard",
    "not-clean": "a ring has the wrong orientation, or an edge shorter than a millimetre",
    "bad-angle": "an angle is not 0, 90 or within 5 to 85 degrees",
    "bad-height": "a height is not finite, the walls have no height, or a maximum is negative",
    "too-many-events": "the wavefront of the skeleton has more events than a polygon can have",
    "broken-wavefront": "the wavefront of the skeleton became inconsistent",
    "no-event": "the wavefront of the skeleton still moves but meets nothing",
    "overflow": "a work array of the kernel is full",
    "open-face": "a face of the solid has an open boundary",
    "not-triangulated": "a face of the solid could not be triangulated",
    "not-closed": "the mesh is not closed",
    "wrong-genus": "the mesh does not have one hole per courtyard",
    "not-planar": "a face of the mesh is not planar",
    "wrong-area": "the roof or the ground does not have the area of the footprint",
    "zero-area-triangle": "a triangle of the mesh has no area",
    "inside-out": "the mesh encloses a negative volume",
}
