"""One self-contained page of a scene: walk around, names of objects, and its assembly as a film."""

from pathlib import Path

import numpy as np

from registry import SceneBundle, SceneRegistry
from studio.assembly import assembly_steps, pose_at
from studio.layers.names import NameLayer
from studio.scene_view import StudioPage
from studio.text import plain

MAX_BYTES = 25_000_000
_STEP_S, _FPS = 0.55, 20  # of the replay: one object, frames
_START_S, _PAUSE_S, _END_S = 0.8, 0.15, 1.0
_CAPTION = (
    "position:fixed;right:14px;top:12px;z-index:5;pointer-events:none;font:13px/1.45 system-ui,sans-serif;"
    "color:#22282e;background:rgba(255,255,255,.82);border-radius:7px;padding:6px 11px"
)
# viser's player repeats a recording for ever. This presses its pause key once, half a second before the end, when the
# player gets there by itself; from then on the scene stays, and the player's bar replays the assembly.
_STOP = """<script>
(() => {
  let before = 0, then = Date.now(), done = false;
  setInterval(() => {
    const bar = document.querySelector("[role=slider][aria-valuemax]");
    const now = bar ? parseFloat(bar.getAttribute("aria-valuenow")) : 0, ms = Date.now();
    const end = bar ? parseFloat(bar.getAttribute("aria-valuemax")) - 0.5 : Infinity;
    const plays = now > before && now - before < 0.005 * (ms - then) + 0.1;
    if (now < 0.5) done = false;
    if (!done && plays && now >= end) {
      done = true;
      window.dispatchEvent(new KeyboardEvent("keydown", { code: "Space" }));
    }
    before = now;
    then = ms;
  }, 60);
})();
</script>"""


def export_html(registry: SceneRegistry, scene_id: str) -> str:
    """Return a page that shows a scene without a server: meshes, names, and the assembly replayed."""
    page = StudioPage(registry, scene_id)
    try:
        NameLayer(page).set(True)
        _lift(page)
        recording = page.server.get_scene_serializer()
        recording.insert_sleep(_START_S)
        for number, step in enumerate(assembly_steps(page.bundle)):
            for share in np.linspace(0, 1, round(_STEP_S * _FPS) + 1)[1:]:
                pose = pose_at(step, number, number + share)
                assert pose is not None  # share > 0
                page.set_pose(step.object_id, pose)
                page.show_object(step.object_id, True)
                recording.insert_sleep(1 / _FPS)
            recording.insert_sleep(_PAUSE_S)
        recording.insert_sleep(_END_S)
        return _dressed(recording.as_html(), page.bundle)
    finally:
        page.close()


def write_export(registry: SceneRegistry, scene_id: str, path: Path) -> int:
    """Write the page; return its size in bytes."""
    data = export_html(registry, scene_id).encode("utf-8")
    path.write_bytes(data)
    return len(data)


def _lift(page: StudioPage) -> None:
    for item in page.bundle.objects:
        page.show_object(item.id, False)


def _dressed(html: str, bundle: SceneBundle) -> str:
    """Put the scene's name in title and caption, and into a mark that `simrecon report` finds."""
    scene_id, count = bundle.scene["id"], len(bundle.objects)
    things = "1 object" if count == 1 else f"{count} objects"
    caption = (
        f'<div style="{_CAPTION}"><b>{plain(scene_id)}</b> &middot; {things} &middot; SimRecon/{plain(scene_id)}<br>'
        '<span style="opacity:.7">drag to look around, right-drag to move, scroll to come nearer</span></div>'
    )
    start, end = html.find("<title>"), html.find("</title>")
    if 0 <= start < end:
        html = f"{html[:start]}<title>{plain(scene_id)}{html[end:]}"
    head = html.index("<head>") + len("<head>")
    html = f'{html[:head]}<meta name="simrecon-scene" content="{plain(scene_id)}">{html[head:]}'
    place = html.rindex("</body>")
    return html[:place] + caption + _STOP + html[place:]
