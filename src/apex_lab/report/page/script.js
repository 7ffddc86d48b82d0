"use strict";

// The reading under the pointer: for each configuration the one nearest to it.
for (const figure of document.querySelectorAll(".chart")) {
  const drawing = figure.querySelector("svg"), pointer = figure.querySelector(".pointer");
  const series = [...figure.querySelectorAll(".series")].map(group => ({group, readings: JSON.parse(group.dataset.readings)}));
  const tip = document.createElement("div");
  tip.className = "tip";
  tip.hidden = true;
  tip.setAttribute("aria-hidden", "true");
  figure.append(tip);
  const hide = () => { tip.hidden = true; pointer.style.visibility = "hidden"; };
  drawing.addEventListener("pointerleave", hide);
  const read = event => {
    const box = drawing.getBoundingClientRect(), frame = figure.getBoundingClientRect();
    const x = (event.clientX - box.left) / box.width * drawing.viewBox.baseVal.width;
    const near = series.filter(one => one.readings.length && !one.group.classList.contains("off")).map(one => ({
      group: one.group, reading: one.readings.reduce((a, b) => Math.abs(b[0] - x) < Math.abs(a[0] - x) ? b : a),
    }));
    if (!near.length) { hide(); return; }
    const at = near.reduce((a, b) => Math.abs(b.reading[0] - x) < Math.abs(a.reading[0] - x) ? b : a).reading[0];
    pointer.setAttribute("x1", at);
    pointer.setAttribute("x2", at);
    pointer.style.visibility = "visible";
    tip.replaceChildren(...near.map(({group, reading}) => {
      const row = document.createElement("div"), swatch = document.createElement("i");
      swatch.className = group.classList[1];
      row.append(swatch, `${group.dataset.label}: ${reading[2]} (step ${reading[1]})`);
      return row;
    }));
    tip.hidden = false;
    const left = event.clientX - frame.left;
    tip.style.left = `${Math.max(0, Math.min(left + 14, frame.width - tip.offsetWidth))}px`;
    tip.style.top = `${event.clientY - frame.top + 18}px`;
  };
  drawing.addEventListener("pointermove", read);
  drawing.addEventListener("pointerdown", read);
}

// A click on a legend's entry takes its configuration out of the charts, and back in.
for (const button of document.querySelectorAll(".legend button")) {
  button.addEventListener("click", () => {
    const shown = button.getAttribute("aria-pressed") === "false";
    button.setAttribute("aria-pressed", String(shown));
    for (const group of button.closest(".panel").querySelectorAll(`.series.${button.dataset.key}`))
      group.classList.toggle("off", !shown);
  });
}

// A movie shows its first frame when it comes near the window, not before.
if ("IntersectionObserver" in window) {
  const seen = new IntersectionObserver(entries => {
    for (const entry of entries) if (entry.isIntersecting) { entry.target.preload = "metadata"; seen.unobserve(entry.target); }
  }, {rootMargin: "300px"});
  for (const movie of document.querySelectorAll("video")) seen.observe(movie);
}

// Paper cannot be unfolded.
let folded = [];
addEventListener("beforeprint", () => {
  folded = [...document.querySelectorAll("details:not([open])")];
  for (const part of folded) part.open = true;
});
addEventListener("afterprint", () => { for (const part of folded) part.open = false; });
