// Turntables, zoomed images (arrow keys step through their row), highlight of the current section.
document.documentElement.classList.add("js");

for (const turn of document.querySelectorAll(".turn")) {
  const slider = turn.querySelector("input");
  const shown = turn.querySelector(".window");
  const count = Number(slider.max) + 1;
  const show = (k) => {
    slider.value = ((Math.round(k) % count) + count) % count;
    turn.style.setProperty("--k", slider.value);
  };
  slider.addEventListener("input", () => show(Number(slider.value)));
  shown.addEventListener("pointerdown", (event) => {
    const from = event.clientX, began = Number(slider.value);
    shown.setPointerCapture(event.pointerId);
    shown.onpointermove = (move) => show(began + ((from - move.clientX) / shown.clientWidth) * count);
    shown.onpointerup = shown.onpointercancel = () => { shown.onpointermove = null; };
  });
}

const dialog = document.getElementById("zoom");
let group = [], at = 0;
function zoom(k) {
  at = (k + group.length) % group.length;
  const frame = group[at];
  const inner = frame.cloneNode(true);
  dialog.querySelector("div").replaceChildren(...inner.childNodes);
  const picture = frame.querySelector("img");
  dialog.style.setProperty("--ratio", picture.naturalWidth / picture.naturalHeight);
  const caption = frame.parentNode.querySelector("figcaption");
  dialog.querySelector("p").textContent = caption ? caption.textContent : picture.alt;
}
for (const frame of document.querySelectorAll(".frame.zoom")) {
  frame.addEventListener("click", () => {
    group = [...frame.parentNode.parentNode.querySelectorAll(":scope > .picture > .frame.zoom")];
    zoom(group.indexOf(frame));
    dialog.showModal();
  });
}
dialog.addEventListener("click", () => dialog.close());
dialog.addEventListener("keydown", (event) => {
  if (event.key === "ArrowRight") zoom(at + 1);
  if (event.key === "ArrowLeft") zoom(at - 1);
});

const links = new Map([...document.querySelectorAll("nav a")].map((a) => [a.getAttribute("href").slice(1), a]));
const watcher = new IntersectionObserver((entries) => {
  for (const entry of entries) {
    if (!entry.isIntersecting) continue;
    for (const [id, link] of links) link.classList.toggle("here", id === entry.target.id);
  }
}, { rootMargin: "-20% 0px -70% 0px" });
document.querySelectorAll("section").forEach((section) => watcher.observe(section));

addEventListener("beforeprint", () => {
  for (const details of document.querySelectorAll("details")) details.open = true;
});
