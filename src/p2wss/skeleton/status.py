"""All reasons for which the kernel rejects a polygon."""

from enum import IntEnum


class Status(IntEnum):
    """``OK``, or the reason why a polygon has no mesh. Every polygon has exactly one."""

    OK = 0
    # of the footprint
    EMPTY = 1  # no ring, or fewer than three vertices
    NON_FINITE = 2  # NaN or infinity among the coordinates
    TOO_SMALL = 3  # the exterior encloses less than the minimum area
    TOO_MANY_EDGES = 4
    NOT_SIMPLE = 5  # a ring crosses or touches itself or another ring
    COURTYARD_OUTSIDE = 6  # a courtyard outside the exterior, or inside another courtyard
    # of the arguments of build()
    NOT_CLEAN = 7  # wrong orientation, or an edge shorter than a millimetre
    BAD_ANGLE = 8  # an angle that is not 0, 90 or within 5..85 degrees
    BAD_HEIGHT = 9  # heights not finite, no wall height, or a negative maximum
    # of the wavefront
    TOO_MANY_EVENTS = 10
    BROKEN_WAVEFRONT = 11
    NO_EVENT = 12  # a wavefront that still moves meets nothing
    OVERFLOW = 13  # a work array is full
    # of the faces and the mesh
    OPEN_FACE = 14
    NOT_TRIANGULATED = 15
    NOT_CLOSED = 16
    WRONG_GENUS = 18
    NOT_PLANAR = 19
    WRONG_AREA = 20
    ZERO_AREA_TRIANGLE = 21
    INSIDE_OUT = 22

    @property
    def reason(self) -> str:
        """The name in kebab-case, for example ``not-simple``."""
        return self.name.lower().replace("_", "-")


# the same as plain integers, which is what compiled code takes
(
    OK,
    EMPTY,
    NON_FINITE,
    TOO_SMALL,
    TOO_MANY_EDGES,
    NOT_SIMPLE,
    COURTYARD_OUTSIDE,
    NOT_CLEAN,
    BAD_ANGLE,
    BAD_HEIGHT,
    TOO_MANY_EVENTS,
    BROKEN_WAVEFRONT,
    NO_EVENT,
    OVERFLOW,
    OPEN_FACE,
    NOT_TRIANGULATED,
    NOT_CLOSED,
    WRONG_GENUS,
    NOT_PLANAR,
    WRONG_AREA,
    ZERO_AREA_TRIANGLE,
    INSIDE_OUT,
) = map(int, Status)
