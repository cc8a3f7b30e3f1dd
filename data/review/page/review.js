// The review page: fetches a pair, shows it, sends the answer; the reply is the next pair.
import { showAgreement } from "./agreement.js";
import { Charts } from "./charts.js";
import { Sliders } from "./sliders.js";

const STYLES = ["conservative", "moderate", "aggressive"];
const LEVELS = { I: "says it outright", II: "a strong hint", III: "a mild hint" };
const DONE = { accept: "Accepted", edit: "Saved as edited", reject: "Rejected", skip: "Skipped" };
const NAME_KEY = "ridetune-annotator";

const $ = (id) => document.getElementById(id);
const charts = new Charts($("charts"));
let sliders, annotator = "", shown = null, undoable = null, busy = false;

const call = async (address, body) => {
  const asked = body === undefined ? {} : {
    method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body),
  };
  let answer;
  try { answer = await fetch(address, asked); }
  catch { throw Object.assign(new Error("The review server does not answer, so nothing was kept. Start it again, then repeat."), { status: 0 }); }
  const content = await answer.json();
  if (!answer.ok) throw Object.assign(new Error(content.error), { status: answer.status });
  return content;
};

let fading;
const notify = (text, kind = "") => {
  clearTimeout(fading);
  if (text && !kind) fading = setTimeout(() => notify(""), 4000); // a refusal stays
  $("notice").hidden = !text;
  $("notice").className = kind;
  $("notice").textContent = text && text[0].toUpperCase() + text.slice(1);
};

// --- time spent looking, while the page is in view ---
const clock = { spent: 0, since: null };
const start = () => { clock.spent = 0; clock.since = document.hidden ? null : performance.now(); };
const seconds = () => (clock.spent + (clock.since === null ? 0 : performance.now() - clock.since)) / 1000;
document.addEventListener("visibilitychange", () => {
  if (document.hidden && clock.since !== null) { clock.spent += performance.now() - clock.since; clock.since = null; }
  else if (!document.hidden) clock.since = performance.now();
});

// --- one pair ---
const same = (a, b) => a.every((value, i) => value === b[i]);
const isChanged = () => shown.style !== shown.item.style || !same(sliders.values, shown.item.values);

const setStyle = (style) => {
  if (shown.style !== undefined) shown.kept[shown.style] = sliders.values; // what was set by hand
  shown.style = style;
  sliders.set(shown.item.values, shown.item.starts[style], shown.kept[style] ?? shown.item.starts[style], style);
  $("review").dataset.style = style;
  $("explanation").textContent = shown.item.explanations[style];
  for (const button of $("styles").children) button.setAttribute("aria-pressed", button.dataset.style === style);
  refresh();
};

const updateButtons = () => {
  const open = shown !== null && !$("review").hidden;
  const changed = open && isChanged();
  $("accept").disabled = !open || changed;
  $("edit").disabled = !changed || shown.fault !== null;
  $("reset").disabled = !changed;
  $("reject").disabled = $("skip").disabled = !open;
  $("undo").disabled = undoable === null;
  $("undo").lastChild.textContent = undoable === null ? "undo" : `undo ${undoable.action}`;
};

// The newest matrix is driven; what a slider passed on the way is not waited for.
let driving = false, waiting = false;
const refresh = async () => {
  updateButtons();
  if (driving) { waiting = true; return; }
  driving = true;
  try {
    do {
      waiting = false;
      const mine = shown, values = sliders.values;
      const preview = same(values, mine.item.values)
        ? mine.item.preview : await call("/api/preview", { values, condition: mine.item.condition });
      if (mine === shown) showPreview(preview);
    } while (waiting);
  } catch (error) { notify(error.message, "bad"); } finally { driving = false; }
};

const showPreview = (preview) => {
  charts.show(shown.item.preview, preview);
  sliders.forbidAbove(preview.ki_limit);
  shown.fault = preview.fault;
  $("fault").hidden = preview.fault === null;
  $("fault").textContent = preview.fault ?? "";
  updateButtons();
};

const chip = (text) => Object.assign(document.createElement("li"), { textContent: text });

const showItem = (item) => {
  shown = { item, kept: {}, fault: null };
  $("frame").src = `/api/frame/${item.proposal_id}`;
  $("frame").alt = `Camera frame: ${item.scene}`;
  $("caption").textContent = `${item.frame_name} · source: ${item.source} · licence: ${item.licence}`;
  $("instruction").textContent = item.instruction;
  $("scene").textContent = item.scene;
  const speed = item.speed_mps === null ? [] : [`${Math.round(item.speed_mps * 3.6)} km/h`];
  $("facts").replaceChildren(
    chip(`Level ${item.level} · ${LEVELS[item.level]}`), chip(item.condition),
    ...speed.map(chip), chip(`${item.split} split`),
    chip(`${item.proposed_by}, ${Math.round(item.confidence * 100)} % of the facts known`));
  charts.reset();
  if (item.was?.action === "edit") shown.kept[item.was.style] = item.was.values;
  setStyle(item.was?.action === "edit" ? item.was.style : item.style);
  start();
};

const show = (next) => {
  const { item, progress } = next;
  annotator = next.annotator;
  undoable = next.last;
  $("who").textContent = annotator;
  $("bar").max = progress.all;
  $("bar").value = progress.done;
  $("progress").textContent = `${progress.done} / ${progress.all} done · ${progress.mine} by you`;
  $("review").hidden = item === null;
  $("done").hidden = item !== null;
  if (item === null) { shown = null; showDone(progress); updateButtons(); } else showItem(item);
  showTab("review");
};

const showDone = (progress) => {
  const left = progress.all - progress.done;
  $("done-title").textContent = left ? "Nothing more for you at the moment" : "Every pair has an answer";
  $("done-text").textContent = `${progress.done} of ${progress.all} pairs are answered, ${progress.mine} by you; `
    + `${progress.second_done} of ${progress.second_wanted} second opinions are in, `
    + `${progress.disputed} disputed pairs wait for a third annotator.`;
  $("again").hidden = !progress.skipped;
};

// --- answers ---
const attempt = async (work, said) => {
  if (busy) return;
  busy = true;
  try {
    show(await work());
    notify(said);
  } catch (error) {
    notify(error.message, "bad");
    if (error.status === 409) { try { show(await call(nextAddress(false))); } catch (again) { notify(again.message, "bad"); } }
  } finally { busy = false; }
};

const nextAddress = (skipped) => `/api/next?annotator=${encodeURIComponent(annotator)}&skipped=${skipped}`;

const answer = (action) => {
  if ($(action).disabled) {
    if (action === "accept" && shown) notify("You changed something: E saves it, Esc goes back to what was proposed.", "bad");
    if (action === "edit" && shown) notify(shown.fault ?? "Nothing was changed: Enter accepts it as proposed.", "bad");
    return;
  }
  const own = action === "edit" ? { style: shown.style, values: sliders.values } : {};
  const { proposal_id, base } = shown.item;
  attempt(() => call("/api/reviews", { proposal_id, annotator, action, base, seconds: seconds(), ...own }), `${DONE[action]}.`);
};

const actions = {
  enter: () => answer("accept"), e: () => answer("edit"), r: () => answer("reject"), s: () => answer("skip"),
  u: () => undoable && attempt(() => call("/api/undo", { annotator, number: undoable.number }), "Taken back; here it is again."),
  escape: () => { if ($("figure").classList.contains("large")) actions.f(); else if (shown) { shown.kept = {}; shown.style = undefined; setStyle(shown.item.style); } },
  k: () => $("again").hidden || $("done").hidden || attempt(() => call(nextAddress(true)), ""),
  f: () => $("figure").classList.toggle("large"),
  g: () => showTab($("agreement").hidden ? "agreement" : "review"),
  ...Object.fromEntries(STYLES.map((style, i) => [String(i + 1), () => shown && setStyle(style)])),
};
const needsPair = new Set(["enter", "e", "r", "s", "escape", "1", "2", "3", "f"]);

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || $("name").open) return;
  const key = event.key.toLowerCase();
  if (event.repeat && !key.startsWith("arrow")) { if (key in actions) event.preventDefault(); return; }
  if (key === "enter" && event.target.closest("button")) return; // it presses that button
  if (!(key in actions) || (needsPair.has(key) && !$("agreement").hidden)) return;
  event.preventDefault();
  actions[key]();
});

const showTab = async (tab) => {
  const agreement = tab === "agreement";
  $("agreement").hidden = !agreement;
  $("review").hidden = agreement || shown === null;
  $("done").hidden = agreement || shown !== null;
  $("keys").hidden = agreement;
  $("tab-review").setAttribute("aria-pressed", !agreement);
  $("tab-agreement").setAttribute("aria-pressed", agreement);
  updateButtons();
  const page = agreement ? $("agreement") : shown ? $("review") : $("done");
  page.focus({ preventScroll: true });
  if (agreement) try { showAgreement($("agreement"), await call("/api/agreement")); } catch (error) { notify(error.message, "bad"); }
};

// --- who ---
const askName = async (fault = "") => {
  $("name-fault").hidden = !fault;
  $("name-fault").textContent = fault;
  $("name-input").value = annotator;
  $("name").returnValue = "";
  $("name").showModal();
  $("name-input").select();
};
$("name").addEventListener("close", () => $("name").returnValue && begin($("name-input").value.trim()));
$("name").addEventListener("cancel", (event) => { if (!annotator) event.preventDefault(); });

const begin = async (name) => {
  if (!name) return askName();
  try {
    show(await call(`/api/next?annotator=${encodeURIComponent(name)}`));
    localStorage.setItem(NAME_KEY, annotator);
    notify("");
  } catch (error) { if (error.status === 422) askName(error.message); else notify(error.message, "bad"); }
};

// --- the start ---
updateButtons();
STYLES.forEach((style, i) => {
  const button = Object.assign(document.createElement("button"), { type: "button", tabIndex: -1 });
  const key = Object.assign(document.createElement("kbd"), { textContent: i + 1 });
  button.dataset.style = style;
  button.append(key, style);
  button.addEventListener("click", () => actions[i + 1]());
  $("styles").append(button);
});
for (const [id, key] of Object.entries({ accept: "enter", edit: "e", reject: "r", skip: "s", undo: "u", reset: "escape", again: "k", figure: "f" }))
  $(id).addEventListener("click", () => actions[key]());
$("tab-review").addEventListener("click", () => showTab("review"));
$("tab-agreement").addEventListener("click", () => showTab("agreement"));
$("who").addEventListener("click", () => askName());
try {
  sliders = new Sliders($("sliders"), (await call("/api/sliders")).sliders, refresh);
  begin(new URLSearchParams(location.search).get("annotator") ?? localStorage.getItem(NAME_KEY) ?? "");
} catch (error) { notify(error.message, "bad"); }
