// Grades of a figure by two limits: good within one, bad beyond the other, fair between.

/** Of a figure that is to be small. */
export const gradeOfSmall = (value, { good, bad }) =>
  value <= good ? "good" : value <= bad ? "fair" : "bad";

/** The grade of a value; `before` stays where a change of the value by `percent` brings it back. */
export const steady = (gradeOf, value, before, percent) =>
  [-percent, percent].some((change) => gradeOf(value * (1 + change / 100)) === before)
    ? before
    : gradeOf(value);

/** Of a figure that is to be great. */
export const gradeOfGreat = (value, { good, bad }) =>
  value >= good ? "good" : value >= bad ? "fair" : "bad";
