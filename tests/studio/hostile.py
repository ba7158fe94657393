"""Text that must be shown as text: HTML, Markdown, a right-to-left override and a control character."""

HOSTILE = "<img src=x onerror='window.hacked=1'>**b** `c` {1+1} \u202egnp.exe\x07"
