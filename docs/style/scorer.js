// Ranks the results of a search: tutorials and guides first, then background and reference, then the API.
const RANKS = [
  ["docs/tutorials/", 30],
  ["docs/guides/", 30],
  ["docs/index", 20],
  ["docs/background/", 15],
  ["docs/reference/api", -40],
  ["docs/reference/", 10],
];

var Scorer = {
  score: (result) => {
    const [page, , , , score] = result;
    const found = RANKS.find(([start]) => page.startsWith(start));
    return score + (found ? found[1] : 0);
  },
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
