"""The gallery: all scenes of a registry on one page, with their pictures and environment ids."""

import secrets
from urllib.parse import quote

from registry import SceneRecord, SceneRegistry
from studio.text import plain

_STYLE = """
:root { color-scheme: light dark; --ink: #22282e; --soft: #6b757f; --card: #fff; --ground: #f4f6f7; --brand: #266e8e; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e7ebee; --soft: #9aa5af; --card: #23292f; --ground: #171b1f; --brand: #6db3d1; }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--ground); color: var(--ink); font: 15px/1.5 system-ui, sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 36px 24px 60px; }
h1 { font-size: 22px; font-weight: 600; margin: 0; }
p { color: var(--soft); margin: 4px 0 26px; }
.scenes { display: grid; grid-template-columns: repeat(auto-fill, minmax(264px, 1fr)); gap: 20px; }
article { background: var(--card); border-radius: 10px; overflow: hidden; box-shadow: 0 1px 4px rgba(0, 0, 0, .12); }
article a { display: block; text-decoration: none; color: inherit; }
article img, .none { display: block; width: 100%; aspect-ratio: 4 / 3; object-fit: cover; background: var(--ground); }
.none { display: grid; place-items: center; color: var(--soft); }
.name { font-weight: 600; padding: 11px 14px 0; overflow-wrap: anywhere; }
.facts { color: var(--soft); font-size: 13px; padding: 0 14px; }
.id { display: flex; gap: 8px; align-items: center; padding: 8px 14px 13px; }
code { font-size: 12.5px; overflow-wrap: anywhere; flex: 1; }
button { border: 1px solid var(--brand); color: var(--brand); background: none; border-radius: 5px; font: inherit;
  font-size: 12.5px; padding: 1px 9px; cursor: pointer; }
button:hover { background: var(--brand); color: var(--card); }
"""
_SCRIPT = """
document.querySelectorAll("button[data-id]").forEach((button) => button.addEventListener("click", async () => {
  const text = button.dataset.id;
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    const field = document.createElement("textarea");
    field.value = text; document.body.append(field); field.select(); document.execCommand("copy"); field.remove();
  }
  button.textContent = "Copied";
  setTimeout(() => { button.textContent = "Copy"; }, 1500);
}));
"""
_STATUS = {"stable": "rests", "unstable": "does not rest", "unchecked": "not simulated"}


def gallery_html(registry: SceneRegistry) -> tuple[str, str]:
    """Return the page of all scenes, newest first, and its Content-Security-Policy."""
    nonce = secrets.token_urlsafe(12)
    records = sorted(registry.list(), key=lambda record: record.created_utc, reverse=True)
    count = "1 scene" if len(records) == 1 else f"{len(records)} scenes"
    body = "".join(_card(record) for record in records)
    if not records:
        body = "<p>No scene yet. <code>simrecon reconstruct VIDEO</code> makes one.</p>"
    page = (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>SimRecon studio</title>"
        f'<meta name=viewport content="width=device-width, initial-scale=1"><link rel=icon href="data:,">'
        f"<style nonce={nonce}>{_STYLE}</style><main><h1>Scenes</h1>"
        f"<p>{count} in {plain(registry.root)}</p><div class=scenes>{body}</div></main>"
        f"<script nonce={nonce}>{_SCRIPT}</script></html>"
    )
    policy = (
        f"default-src 'none'; img-src 'self' data:; style-src 'nonce-{nonce}'; script-src 'nonce-{nonce}'; "
        "base-uri 'none'; form-action 'none'"
    )
    return page, policy


def message_html(title: str, text: str) -> str:
    """Return a page with one message."""
    return (
        f'<!doctype html><html lang=en><meta charset=utf-8><title>{plain(title)}</title><link rel=icon href="data:,">'
        f"<style>{_STYLE}</style><main><h1>{plain(title)}</h1><p>{plain(text)}</p></main></html>"
    )


def _card(record: SceneRecord) -> str:
    address, environment = f"/s/{quote(record.scene_id)}/", f"SimRecon/{record.scene_id}"
    if (record.path / "preview.png").is_file():
        picture = f'<img loading=lazy alt="{plain(record.scene_id)}" src="/preview/{quote(record.scene_id)}">'
    else:
        picture = "<div class=none>no picture</div>"
    things = "1 object" if record.n_objects == 1 else f"{record.n_objects} objects"
    facts = (
        f"{things}, {_STATUS.get(record.status, plain(record.status))} &middot; {plain(record.source_file)}"
    )
    return (
        f'<article><a href="{address}">{picture}<div class=name>{plain(record.scene_id)}</div></a>'
        f"<div class=facts>{facts}</div><div class=facts>{plain(record.created_utc[:10])}</div>"
        f'<div class=id><code>{plain(environment)}</code><button data-id="{plain(environment)}">Copy</button></div>'
        "</article>"
    )
