"""How the numbers of an evaluation are computed: the text of docs/metrics.md, which docstrings cite by section."""

from __future__ import annotations

PROTOCOL = """## 0. Input
A video has T frames, counted from 0. Its ground truth is one label per pixel: 0 is the background, every other label
is one object for the whole video. In P2D the robot arm is an object (label 1), the table is background.

A model gives soft masks that sum to 1 over its components, and an identity per component and frame (−1: absent). The
prediction is one identity per pixel:

1. Masks of another size than the ground truth are resized to it, bilinearly, before the argmax (models by default,
   files of predictions with `resize=masks`). `scoring.resize=truth`, or `resize=truth` of files, brings the truth to
   the size of the prediction by nearest neighbour instead. Without `resize`, files of another size are refused.
2. Object components with a presence below `scoring.min_presence` (0.5) are taken out before the argmax, so their
   pixels go to the next best component. With `scoring.presence_after` they are taken out after it, and their pixels
   form one segment of nothing. Background components are never taken out.
3. Argmax over the components, in float32; ties go to the component with the lowest index.

The background takes part like any other component. Files of predictions hold masks (npz, soft or one-hot) or
identities; where a format leaves pixels without a mask, these form one more segment over the whole video.

All scores are functions of one table per frame: how many pixels each true label shares with each predicted identity.
Names of labels and identities, the order of videos and the batch size change nothing.

## 1. Segmentation
### 1.1 ARI and ARI-FG
The adjusted Rand index [1] between true labels and predicted identities of a set of pixels. `ari` takes all pixels of
a frame, with the background as one label; `ari_fg` the pixels of true objects alone, so a segment that spills onto
the background costs nothing. Both are 1 at most, 0 for chance, and can be negative. Degenerate sets:

| case | value |
|---|---|
| no pixel (`ari_fg` in a frame without objects) | 1 |
| one true label and one identity | 1 |
| one true label and several identities, or the reverse | 0 |
| every pixel a label and an identity of its own | 1 |

So `ari_fg` of a frame with one visible object is 1 or 0.

### 1.2 Covering: MSC, MSC-FG, SC, SC-FG
Every true region takes the best IoU that it has with any predicted segment [2]; one segment may cover several
regions. `msc` is the plain mean over the regions of a frame, the background among them; `msc_fg` over the objects
alone; `sc` and `sc_fg` weigh each region by its area. The union counts all pixels of the segment, so spilling onto
the background costs here. A frame without any object has `msc_fg` and `sc_fg` 0. One segment over a frame with n
visible objects has an `msc` of exactly 1 / (n + 1).

### 1.3 Time
`ari`, `ari_fg`, `msc`, `msc_fg`, `sc`, `sc_fg` score each frame by itself, as the published tables do; no identity
over time is needed. The total is the mean over all frames of all videos, a video's value the mean over its frames. An
object that is hidden in a frame does not exist in that frame.

`video_…` takes all pixels of a video as one set, with identities over time as predicted labels [3]; the total is the
mean over videos, each one vote.

`scoring.skip_empty=true` leaves frames (for `video_…`: videos) without any visible object out of the means of ARI-FG,
MSC-FG and SC-FG, which otherwise count them as 1, 0 and 0: it lowers the first and raises the others. `empty_frames`
is their number. `mbo` and `miou` always leave them out.

`scoring.first_frame=k` scores segmentation (section 1, `mbo`, `miou`, J and F) as if every video began at frame k, so
that the first frames, in which a model that works frame by frame still finds its objects, do not count. Frames keep
their numbers; tracking has a first frame of its own (section 2), and results per object are of all frames.

## 2. Tracking
MOTA to MT follow Weis et al. [4], CLEAR MOT [5] with mask IoU, computed with py-motmetrics. For every video:

1. **Masks**: one per identity and frame, from the argmax of section 0. An identity that wins no pixel has none.
2. **Frames**: from `scoring.tracking.first_frame` (0) up to, not including, `stop_frame` (the end). Keys that end in
   `_start2` repeat all but HOTA and J&F from frame 2 on (`scoring.public_first_frame`), the burn-in of the public
   program.
3. **Small masks**: true and predicted masks of 5 pixels or fewer (`min_pixels`) are dropped, frame by frame.
4. **IoU** of all true masks that are left, the background included, with all predicted masks that are left.
5. **Background**: every predicted mask with an IoU above 0.2 (`background_iou`) with the true background is removed
   from the frame, then the true background itself. The model's own background plays no part in this; a segment
   of background with a smaller IoU stays and is a false positive. `drop_background_slot=true` removes the model's own
   background first.
6. **Threshold**: a pair can match if its IoU is at least 0.5 (`min_iou`).
7. **Matching**: a true object keeps the identity of its last match, however long ago, as long as that identity is in
   the frame and the pair can match. The other objects and predictions are then assigned one to one, as many pairs as
   possible and of those the largest total IoU. A pair under another identity than at the object's last match is a
   switch, else a match; a true object without a pair is a miss, a prediction without one a false positive.
8. **Pooling**: events are counted per video, with identities that are unique to it, and added up over all videos;
   ratios are taken last. No mean of videos' ratios occurs.

### 2.1 Rates
N is the number of occurrences of true objects left after step 5, over all frames and videos.

| key | value |
|---|---|
| `mota` | 100 (1 − (misses + switches + false positives) / N) |
| `motp` | 100 × mean IoU of matches and switches |
| `match`, `id_switches`, `misses`, `fps` | 100 × their number / N; the first three sum to 100, and MOTA = Match − FPs |
| `md` | percent of objects with a match or switch in at least 80 % (`tracked_share`) of their occurrences |
| `mt` | the same with matches alone |

MD can never be smaller than MT. In the paper's table it is, in every row: its two column titles are evidently
exchanged.

### 2.2 HOTA and IDF1
Both see the masks that steps 1 to 5 leave, not the raw ones. This matters: on
`tests/metrics/fixtures/metrics_public.npz` HOTA is 0.748 and IDF1 0.779; with all masks, background included, they
are 0.630 and 0.624 (`min_pixels: 0`, `background_iou: null`).

HOTA [6]: at each threshold α = 0.05, 0.10, …, 0.95, predictions are assigned to objects frame by frame so that IoU,
weighted by how well the two tracks agree over the video, is largest; pairs with IoU ≥ α are true positives. DetA is
the share of true positives among them, misses and false positives; AssA the mean over true positives of the share
that the pair's true positives have of the union of both tracks; HOTA = √(DetA · AssA), then the mean over α. IDF1
[7]: tracks are assigned one to one so that the frames in which they agree (IoU ≥ 0.5) are most. Both are pooled like
step 8: counts of all videos are added up, then the ratios are taken; the data set's HOTA is not the mean of the
videos'. No prediction at all has HOTA 0 and, by convention, LocA 1.

### 2.3 Undefined values
A mean over nothing is `null` and never enters another mean: rates without any true object, MOTP without any match.

### 2.4 Identities
| model | identity | tracking |
|---|---|---|
| objects with identities (APEX, SCALOR, G-SWM) | given at discovery, kept by propagation | yes |
| video slots (OP3) | index of the slot | yes |
| single images (SPACE, Slot Attention) | none over time | `null`; an extra: `scoring.identities=linked` |

`linked` takes a segment for the one of the frame before that it is assigned to by the largest total IoU.

## 3. Tables
A row is a configuration that a sweep names, with the seeds that it names. One number per seed from the whole test set;
then mean and standard deviation over seeds with ddof = 1. Rounded once, when printed. A seed has failed if its loss
became non-finite, or if it gives objects less than 0.1 % or more than 99.9 % of the validation pixels; failed seeds are
left out where the table says so, with their number in the footnote.

## 4. Beyond the paper
`mbo` [8]: mean over the objects of a frame of the best IoU with any predicted mask. `miou`: objects and predicted
masks are assigned one to one for the largest total IoU; an object without a partner scores 0. Frames without objects
have no value. `video_mbo` and `video_miou` take space-time volumes; their total is the mean over videos with objects.

`j`, `f` and their mean `jf` [9] take raw masks: none is dropped, neither small ones nor those of the background. True
objects and predicted identities of a video are assigned one to one so that the mean J over all frames is largest, and
an object keeps its partner for the whole video. Where there are fewer identities than objects, empty masks make up
the number; surplus identities cost nothing. J is the IoU of the pair in a frame, F the harmonic mean of precision and
recall of boundary pixels, where one counts as found if the other mask's boundary lies within 0.8 % of the image
diagonal, rounded up to whole pixels (`scoring.boundary_tolerance`). In a frame in which both masks are empty, object
hidden and nothing predicted, both are 1; if one is empty, 0. Each object's value is the mean over all frames, the
total the mean over the objects of all videos. In small images F depends strongly on the tolerance.

## 5. Ignored pixels
`scoring.ignore_label=255` (any number) leaves the pixels with that true label out of every score: they are in no
region, no mask, no volume and no boundary, whatever is predicted there. Areas (`min_pixels`, weights of `sc`) are
those of the pixels that are left. A frame without any other pixel is left out of the means. In files, the label is
the value in the truth file: an index of a PNG, a value of `V__gt`, an id of MOTS text, a `track_id` of COCO. Truth
that has 255 (or 65535) without numbering its objects that far, a class 10 in MOTS text or an `iscrowd` annotation gets
a warning where the key is absent.

## 6. Files
Frames of image folders are found by the number in their names, videos listed in natural order (v2 before v10).
Prediction and truth pair by frame number; where one side has no numbers, the other's must start at 0 or 1 and have no
gaps. Frames that do not pair are refused. Exports can be scored again and give the same numbers (of a model with
several background components, `npz` and `weis` alone: the others leave the background out), and their truth files
serve as `truth=`:

| `export=` | predictions, `predictions/<split>.…` | truth | read by |
|---|---|---|---|
| `npz` | `npz`: `V__masks`, `V__ids`, `V__gt` | in the same file | NumPy |
| `coco` | `coco.json`: result list with `track_id` | `coco.truth.json`: images, annotations, categories | pycocotools |
| `weis` | `weis.json` | `weis.truth.json` | the program of Weis et al. [4] |
| `davis` | `davis/V/00000.png`: palette images | `davis.truth/V/00000.png`, 255 = ignored | DAVIS's tools, TrackEval |
| `mots` | `mots/V.txt`, class 2 | `mots.truth/V.txt`, class 10 = ignored | TrackEval's `MOTSChallenge` |
| `mot` | `mot/V.txt`: boxes | `mot.truth/V.txt`, class 1; cannot be `truth=` | `MotChallenge2DBox`, motmetrics |

Videos are called `<split>_<number>`, here and by `python -m sims.p2d export`. TrackEval reads the last two with
`GT_FOLDER=predictions/test.mots.truth`, `GT_LOC_FORMAT={gt_folder}/{seq}.txt`, `SKIP_SPLIT_FOL=True`,
`SEQMAP_FILE=predictions/test.mots.truth/seqmaps/all.txt`, `TRACKERS_FOLDER=predictions`, `TRACKERS_TO_EVAL=test.mots`
and an empty `TRACKER_SUB_FOLDER`.

## References
1. Hubert and Arabie, Comparing partitions, Journal of Classification 1985.
2. Arbelaez et al., Contour detection and hierarchical image segmentation, TPAMI 2011; the unscaled form: Engelcke et
   al., GENESIS, ICLR 2020.
3. Kipf et al., Conditional object-centric learning from video (SAVi), ICLR 2022.
4. Weis et al., Benchmarking unsupervised object representations for video sequences, JMLR 2021.
5. Bernardin and Stiefelhagen, Evaluating multiple object tracking performance, EURASIP JIVP 2008.
6. Luiten et al., HOTA, IJCV 2021.
7. Ristani et al., Performance measures and a data set for multi-target, multi-camera tracking, ECCV Workshops 2016.
8. Pont-Tuset et al., Multiscale combinatorial grouping, TPAMI 2017.
9. Pont-Tuset et al., The 2017 DAVIS challenge on video object segmentation, 2017; Perazzi et al., A benchmark dataset
   and evaluation methodology for video object segmentation, CVPR 2016.
"""
