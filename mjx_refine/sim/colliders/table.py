"""Which collider of ours serves which pairing."""

from __future__ import annotations

from mjx_refine.sim.colliders.box_box import POINTS, box_box
from mjx_refine.sim.colliders.contact import GeomType, as_mjx
from mjx_refine.sim.colliders.cylinder_box import cylinder_box
from mjx_refine.sim.colliders.cylinder_cylinder import cylinder_cylinder
from mjx_refine.sim.colliders.plane import plane_box, plane_cylinder
from mjx_refine.sim.colliders.sphere import sphere_box, sphere_cylinder

COLLIDERS = {
    (GeomType.PLANE, GeomType.BOX): as_mjx(plane_box, 4),
    (GeomType.PLANE, GeomType.CYLINDER): as_mjx(plane_cylinder, 4),
    (GeomType.SPHERE, GeomType.BOX): as_mjx(sphere_box, 1),
    (GeomType.SPHERE, GeomType.CYLINDER): as_mjx(sphere_cylinder, 1),
    (GeomType.CYLINDER, GeomType.BOX): as_mjx(cylinder_box, 4),
    (GeomType.CYLINDER, GeomType.CYLINDER): as_mjx(cylinder_cylinder, 4),
    (GeomType.BOX, GeomType.BOX): as_mjx(box_box, POINTS),
}
