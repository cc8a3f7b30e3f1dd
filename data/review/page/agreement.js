// The second tab: how first and second opinions agree.
import { symbol } from "./sliders.js";

const PARAMETERS = ["K_p", "K_i", "K_d", "W_l", "W_h", "W_s"];
const STYLES = ["conservative", "moderate", "aggressive"];

const make = (tag, parent, text, name) => {
  const made = document.createElement(tag);
  if (text !== undefined) made.textContent = text;
  if (name) made.className = name;
  parent.append(made);
  return made;
};

const score = (value) => (value === null ? "\u2013" : value.toFixed(2).replace("-", "\u2212"));

const tile = (parent, value, label) => {
  const made = make("div", parent, undefined, "tile");
  make("b", made, value);
  make("span", made, label);
};

const table = (parent, heads, rows) => {
  const made = make("table", make("div", parent, undefined, "card"));
  const head = make("tr", make("thead", made));
  heads.forEach((text) => {
    const cell = make("th", head, PARAMETERS.includes(text) ? undefined : text);
    if (PARAMETERS.includes(text)) symbol(text, cell);
  });
  const body = make("tbody", made);
  rows.forEach(([name, ...cells]) => {
    const row = make("tr", body);
    make("th", row, name).scope = "row";
    cells.forEach((text) => make("td", row, text));
  });
};

export const showAgreement = (page, { agreement, disputes }) => {
  page.replaceChildren();
  make("h2", page, "Do the annotators agree?");
  if (!agreement.pairs) {
    make("p", page, "No pair has a second opinion yet. A share of the pairs is given to two annotators, who do not see each other's answer; once some are in, this page compares them.", "note");
    return;
  }
  const tiles = make("div", page, undefined, "tiles");
  tile(tiles, agreement.pairs, "pairs with two opinions");
  tile(tiles, score(agreement.kappa), "Cohen's kappa of the style: 1 is full agreement, 0 what chance gives");
  tile(tiles, agreement.one_rejected, `rejected by one of two; ${agreement.both_rejected} by both`);
  tile(tiles, disputes.length, "disputed, waiting for a third annotator");
  make("h3", page, "How alike the values are");
  make("p", page, "ICC(2,1): absolute agreement of a single annotator, over the pairs that both keep. 1 is the same value; where almost all is accepted as proposed, it is close to 1 by itself.", "note");
  table(page, ["", ...PARAMETERS], [["ICC(2,1)", ...agreement.icc.map(score)]]);
  make("h3", page, "Style, the first opinion against the second");
  table(page, ["first \\ second", ...STYLES], agreement.styles.map((row, i) => [STYLES[i], ...row]));
  if (disputes.length) {
    make("h3", page, "Disputed");
    make("p", page, "Which pairs these are is not told here: the third annotator should not know what the others said.", "note");
    const list = make("ul", page);
    disputes.forEach((words) => make("li", list, words));
  }
};
