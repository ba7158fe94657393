"""Text that must be shown as text: HTML and Markdown. Bundles with control characters are refused before."""

HOSTILE = "<img src=x onerror='window.hacked=1'>**b** `c` {1+1}"
WITH_CONTROLS = HOSTILE + " \u202egnp.exe\x07"
