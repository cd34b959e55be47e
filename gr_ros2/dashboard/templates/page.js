// What a keyboard, a screen reader and a dark screen need, and what Bokeh's widgets do not have by themselves.
const everywhere = (root, visit) => {
    visit(root);
    for (const node of root.querySelectorAll("*")) if (node.shadowRoot) everywhere(node.shadowRoot, visit);
};

// Sliders and check boxes have names; a toggle says whether it is pressed; a plot without tools is no stop of the Tab key.
const name = () => everywhere(document, root => {
    const words = selector => (root.querySelector(selector)?.textContent ?? "").split(":")[0];
    for (const handle of root.querySelectorAll(".noUi-handle")) handle.setAttribute("aria-label", words(".bk-slider-title"));
    for (const box of root.querySelectorAll("input[type=checkbox]")) box.setAttribute("aria-label", words(".bk-label"));
    for (const plot of root.querySelectorAll(".bk-events")) plot.tabIndex = -1;
    for (const button of root.querySelectorAll(".bk-btn"))
        if (button.textContent === pause.label) button.setAttribute("aria-pressed", pause.active);
});

const show = () => {
    for (const card of document.querySelectorAll("[data-card]"))
    {
        card.hidden = pulse.empty.split(" ").includes(card.dataset.card);
        card.classList.toggle("waiting", pulse.waits.split(" ").includes(card.dataset.card));
        card.classList.toggle("old", pulse.old.split(" ").includes(card.dataset.card));
    }
    name();
};
const date = () => { for (const head of document.querySelectorAll(".card h2")) head.dataset.ago = pulse.ago; };
const say = () => { document.getElementById("said").textContent = pulse.said; };

const dark = matchMedia("(prefers-color-scheme: dark)");
const paint = () => {
    const ink = getComputedStyle(document.documentElement).getPropertyValue("--soft").trim();
    for (const model of words) model.setv("axis_label_text_color" in model.properties
        ? {axis_label_text_color: ink, major_label_text_color: ink} : {label_text_color: ink});
};

pulse.connect(pulse.properties.empty.change, show);
pulse.connect(pulse.properties.waits.change, show);
pulse.connect(pulse.properties.old.change, show);
pulse.connect(pulse.properties.ago.change, date);
pulse.connect(pulse.properties.said.change, say);
pause.connect(pause.properties.active.change, name);
dark.addEventListener("change", paint);
show();
date();
say();
paint();
for (const fold of document.querySelectorAll("details")) {  // as this viewer has left it, also when the next run is shown
    fold.open = localStorage.getItem(fold.id) === "open";
    fold.addEventListener("toggle", () => localStorage.setItem(fold.id, fold.open ? "open" : ""));
}
