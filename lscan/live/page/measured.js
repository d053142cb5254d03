// What tests and benchmarks read of the page, as window.lscan.
//
// framesDrawn: pictures drawn; profilesDrawn: those of them with stripe and profile; lastNumber:
// of the last; rateHz: pictures drawn a second; plot: the profile's window in mm and px.

export const measured = { framesDrawn: 0, profilesDrawn: 0, lastNumber: 0, rateHz: 0, plot: null };
window.lscan = measured;
