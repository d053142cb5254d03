// Grades of a figure by two limits: good within one, bad beyond the other, fair between.

/** Of a figure that is to be small. */
export const gradeOfSmall = (value, { good, bad }) =>
  value <= good ? "good" : value <= bad ? "fair" : "bad";

/** Of a figure that is to be great. */
export const gradeOfGreat = (value, { good, bad }) =>
  value >= good ? "good" : value >= bad ? "fair" : "bad";
