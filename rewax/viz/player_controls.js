"use strict";
// Buttons, choosers and keys. Names that come from recordings are only ever set as text, never as HTML.

const SPEEDS = [0.05, 0.1, 0.125, 0.25, 0.5, 1, 2, 4];
const byId = (id) => document.getElementById(id);

// Fill a chooser with [value, text]; hide it, with its label, where there is nothing to choose.
function fill(id, choices, chosen, change) {
  const select = byId(id);
  select.replaceChildren(...choices.map(([value, textContent]) => Object.assign(document.createElement("option"), { value, textContent })));
  select.value = chosen;
  select.closest("label").hidden = choices.length < 2;
  select.addEventListener("change", () => change(select.value));
  let clicked = false;  // chosen with the mouse, it gives the keyboard back to the page
  select.addEventListener("pointerdown", () => { clicked = true; });
  select.addEventListener("keydown", () => { clicked = false; });
  select.addEventListener("change", () => { if (clicked) select.blur(); });
}

// Take the next choice of a chooser, after the last one the first.
function nextChoice(id) {
  const select = byId(id);
  if (select.options.length < 2) return;
  select.selectedIndex = (select.selectedIndex + 1) % select.options.length;
  select.dispatchEvent(new Event("change"));
}

// A button that is on or off.
function toggleButton(id, on, change) {
  const button = byId(id);
  const set = (value) => {
    button.setAttribute("aria-pressed", String(value));
    change(value);
  };
  button.addEventListener("click", () => set(button.getAttribute("aria-pressed") !== "true"));
  set(on);
}

function addControls(player, data) {
  const { show, orbit } = player, changed = () => { player.dirty = true; };
  const click = (id, action) => byId(id).addEventListener("click", action);
  byId("timeline").addEventListener("input", (event) => player.seek(player.duration * event.target.value / 1000));
  click("play", () => player.toggle());
  click("home", () => orbit.home());
  for (const name of Object.keys(VIEWS)) click(name, () => orbit.view(name));
  const speeds = [...new Set([...SPEEDS, data.speed])].sort((a, b) => a - b);
  fill("speed", speeds.map((s) => [s, `${Number(s.toPrecision(2))}×`]), data.speed, (value) => { player.speed = Number(value); });
  fill("color", data.colors.map((name) => [name, name]), show.by, (value) => { show.by = value; changed(); });
  fill("plot", player.plots.map((name) => [name, name]), show.plot, (value) => { show.plot = value; changed(); });
  const titles = titlesOf(player.runs);
  fill("camera", [...titles, ""].map((title) => [title, title || "none"]), show.camera, (value) => { show.camera = value; changed(); });
  toggleButton("surface", show.surface, (on) => {
    show.surface = on;
    byId("surface").textContent = on ? "Surface" : "Balls";
    changed();
  });
  byId("surface").hidden = !player.runs.some((run) => run.particles && !run.particles.triangles);
  toggleButton("follow", show.follow, (on) => { show.follow = on; changed(); });
  toggleButton("one", show.one, (on) => { show.one = on; changed(); });
  byId("one").hidden = player.runs.length < 2;
  click("picture", () => savePicture(player));
  byId("video").hidden = !player.recorder.type;
  click("video", () => player.record());
  byId("full").hidden = !document.documentElement.requestFullscreen;
  click("full", () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen()));
  click("help", () => byId("keys").showModal());
  click("more", () => document.body.classList.toggle("open"));
  addKeys(player);
}

function addKeys(player) {
  const step = player.runs[0].dt;
  const buttons = { b: "surface", f: "full", g: "follow", h: "home", o: "one", p: "picture", v: "video", 1: "front", 2: "side", 3: "top", "?": "help" };
  window.addEventListener("keydown", (event) => {
    const typing = event.target.tagName === "SELECT" || (event.target.tagName === "INPUT" && event.target.type !== "range");
    if (typing || event.ctrlKey || event.metaKey || event.altKey || byId("keys").open) return;
    if (event.target.tagName === "BUTTON" && event.key === " ") return;  // the space bar presses the button
    const keys = {
      " ": () => player.toggle(), Home: () => player.seek(0), End: () => player.seek(player.duration),
      c: () => nextChoice("camera"),
      ArrowRight: () => player.seek(player.time + step), ArrowLeft: () => player.seek(player.time - step),
    };
    const action = keys[event.key] || (buttons[event.key] && !byId(buttons[event.key]).hidden && (() => byId(buttons[event.key]).click()));
    if (!action) return;
    event.preventDefault();
    action();
  });
}

// A tab for each run and one for all of them. A narrow screen starts with the first run alone.
function addTabs(player) {
  const names = ["All", ...player.runs.map((run) => run.name)];
  byId("tabs").replaceChildren(...names.map((name, i) => {
    const tab = Object.assign(document.createElement("button"), { textContent: name, title: name });
    tab.addEventListener("click", () => player.choose(i - 1));
    return tab;
  }));
  byId("tabs").hidden = player.runs.length < 2;
}
