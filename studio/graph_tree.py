"""The scene graph as a tree in HTML."""

from typing import TYPE_CHECKING

from studio.text import plain

if TYPE_CHECKING:
    from studio.scene_view import StudioPage

_HUNG = '<span title="hangs on it" style="color:#a85896">&#8640;</span>'
_STANDS = '<span title="stands on it" style="color:#266e8e">&#8627;</span>'


def tree_html(page: "StudioPage", selected: tuple[int, ...] = ()) -> str:
    """Return the forest of the scene graph, rooted in floor and walls; selected objects are marked."""
    children: dict[int, list] = {}
    for edge in page.bundle.edges:
        children.setdefault(edge.parent, []).append(edge)

    def branch(edge) -> str:
        mark = _HUNG if edge.relation == "attached_to" else _STANDS
        name = plain(page.name_of(edge.child))
        shown = (
            f'<b style="background:rgba(38,110,142,.16);border-radius:3px">{name}</b>'
            if edge.child in selected
            else name
        )
        rest = "".join(branch(e) for e in children.get(edge.child, ()))
        return f'<div style="padding-left:16px">{mark} {shown}{rest}</div>'

    roots = "".join(
        f'<div style="margin-bottom:3px"><span style="opacity:.6">{plain(base.label)} {base.id}'
        f"{'' if base.observed else ' (assumed)'}</span>{''.join(branch(e) for e in children.get(base.id, ()))}</div>"
        for base in page.bundle.base
        if base.id in children
    )
    return f'<div style="font-size:12.5px;line-height:1.5;padding:2px 10px">{roots}</div>'
