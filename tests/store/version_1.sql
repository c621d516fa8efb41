-- A store as version 0001 of the tables left it: two stops of two fruit, one rejected, two merged.
-- Written by the software of that version, dumped by sqlite3's iterdump().
BEGIN TRANSACTION;
CREATE TABLE actions (
	id INTEGER NOT NULL, 
	round_id INTEGER, 
	undoes_id INTEGER, 
	at_s DOUBLE NOT NULL, 
	"by" TEXT NOT NULL, 
	kind TEXT NOT NULL, 
	fruit JSON NOT NULL, 
	details JSON NOT NULL, 
	CONSTRAINT pk_actions PRIMARY KEY (id), 
	CONSTRAINT fk_actions_round_id_rounds FOREIGN KEY(round_id) REFERENCES rounds (id), 
	CONSTRAINT fk_actions_undoes_id_actions FOREIGN KEY(undoes_id) REFERENCES actions (id), 
	CONSTRAINT uq_actions_undoes_id UNIQUE (undoes_id)
);
INSERT INTO "actions" VALUES(1,1,NULL,1.79534141793109130861e+09,'ana','reject','["7952d1f6-44d8-5e55-9a7c-8192532ca73a"]','{}');
INSERT INTO "actions" VALUES(2,1,NULL,1.79534141815683436394e+09,'bo','merge','["5ef9d5da-4e98-5688-845f-fdb11d7d3813", "3eeb84d5-c1b5-5af5-aaf5-88a1f2ba8b73"]','{"kind": "same"}');
CREATE TABLE artifacts (
	id INTEGER NOT NULL, 
	kind TEXT NOT NULL, 
	name TEXT NOT NULL, 
	sha256 TEXT NOT NULL, 
	details JSON NOT NULL, 
	CONSTRAINT pk_artifacts PRIMARY KEY (id), 
	CONSTRAINT uq_artifacts_kind_name_sha256 UNIQUE (kind, name, sha256)
);
INSERT INTO "artifacts" VALUES(1,'model','detector','ab','{"runtime": "x"}');
CREATE TABLE captures (
	id INTEGER NOT NULL, 
	stop_id INTEGER NOT NULL, 
	number INTEGER NOT NULL, 
	frame INTEGER NOT NULL, 
	burst_frame INTEGER NOT NULL, 
	burst_size INTEGER NOT NULL, 
	width_px INTEGER NOT NULL, 
	height_px INTEGER NOT NULL, 
	name TEXT NOT NULL, 
	source TEXT NOT NULL, 
	color_sha256 TEXT, 
	depth_sha256 TEXT, 
	thumbnail_sha256 TEXT, 
	timestamp_s DOUBLE, 
	fill DOUBLE, 
	depth_unit_m DOUBLE, 
	simulated BOOLEAN NOT NULL, 
	camera JSON NOT NULL, 
	provenance JSON NOT NULL, 
	CONSTRAINT pk_captures PRIMARY KEY (id), 
	CONSTRAINT fk_captures_stop_id_stops FOREIGN KEY(stop_id) REFERENCES stops (id), 
	CONSTRAINT fk_captures_color_sha256_images FOREIGN KEY(color_sha256) REFERENCES images (sha256), 
	CONSTRAINT fk_captures_depth_sha256_images FOREIGN KEY(depth_sha256) REFERENCES images (sha256), 
	CONSTRAINT fk_captures_thumbnail_sha256_images FOREIGN KEY(thumbnail_sha256) REFERENCES images (sha256), 
	CONSTRAINT uq_captures_stop_id_name UNIQUE (stop_id, name), 
	CONSTRAINT uq_captures_stop_id_number UNIQUE (stop_id, number)
);
INSERT INTO "captures" VALUES(1,1,0,0,0,1,0,0,'a','',NULL,NULL,NULL,NULL,NULL,NULL,0,'{"fx_px": 600.0}','{}');
INSERT INTO "captures" VALUES(2,2,0,0,0,1,0,0,'a','',NULL,NULL,NULL,NULL,NULL,NULL,0,'{"fx_px": 600.0}','{}');
CREATE TABLE cucumbervision_version (
	version_num VARCHAR(32) NOT NULL, 
	CONSTRAINT cucumbervision_version_pkc PRIMARY KEY (version_num)
);
INSERT INTO "cucumbervision_version" VALUES('0001');
CREATE TABLE fruit (
	id INTEGER NOT NULL, 
	capture_id INTEGER NOT NULL, 
	round_id INTEGER NOT NULL, 
	number INTEGER NOT NULL, 
	mask_px INTEGER, 
	"key" TEXT NOT NULL, 
	label TEXT NOT NULL, 
	method TEXT, 
	reason TEXT NOT NULL, 
	fallback TEXT NOT NULL, 
	flags TEXT NOT NULL, 
	length_kind TEXT, 
	interval_of TEXT, 
	interval_basis TEXT, 
	mask_source TEXT, 
	raw_length_kind TEXT, 
	score DOUBLE NOT NULL, 
	box_x1_px DOUBLE NOT NULL, 
	box_y1_px DOUBLE NOT NULL, 
	box_x2_px DOUBLE NOT NULL, 
	box_y2_px DOUBLE NOT NULL, 
	view_score DOUBLE NOT NULL, 
	length_m DOUBLE, 
	length_sd_m DOUBLE, 
	interval_low_m DOUBLE, 
	interval_high_m DOUBLE, 
	centreline_m DOUBLE, 
	thread_m DOUBLE, 
	chord_m DOUBLE, 
	inner_arc_m DOUBLE, 
	diameter_max_m DOUBLE, 
	diameter_mean_m DOUBLE, 
	volume_m3 DOUBLE, 
	tilt_deg DOUBLE, 
	hidden_share DOUBLE, 
	fill DOUBLE, 
	distance_m DOUBLE, 
	raw_length_m DOUBLE, 
	centre_x_m DOUBLE, 
	centre_y_m DOUBLE, 
	centre_z_m DOUBLE, 
	offset_m DOUBLE, 
	offset_sd_m DOUBLE, 
	CONSTRAINT pk_fruit PRIMARY KEY (id), 
	CONSTRAINT fk_fruit_capture_id_captures FOREIGN KEY(capture_id) REFERENCES captures (id), 
	CONSTRAINT fk_fruit_round_id_rounds FOREIGN KEY(round_id) REFERENCES rounds (id), 
	CONSTRAINT uq_fruit_capture_id_number UNIQUE (capture_id, number), 
	CONSTRAINT uq_fruit_key UNIQUE ("key")
);
INSERT INTO "fruit" VALUES(1,1,1,1,NULL,'7952d1f6-44d8-5e55-9a7c-8192532ca73a','cucumber','M6','','','',NULL,NULL,NULL,NULL,NULL,1.0,0.0,0.0,0.0,0.0,0.5,2.10000000000000019984e-01,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,0.1,0.03);
INSERT INTO "fruit" VALUES(2,1,1,2,NULL,'5ef9d5da-4e98-5688-845f-fdb11d7d3813','cucumber','M6','','','',NULL,NULL,NULL,NULL,NULL,1.0,0.0,0.0,0.0,0.0,0.5,0.22,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,0.2,0.03);
INSERT INTO "fruit" VALUES(3,2,1,1,NULL,'3eeb84d5-c1b5-5af5-aaf5-88a1f2ba8b73','cucumber','M6','','','',NULL,NULL,NULL,NULL,NULL,1.0,0.0,0.0,0.0,0.0,0.5,2.10000000000000019984e-01,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,0.1,0.03);
INSERT INTO "fruit" VALUES(4,2,1,2,NULL,'70f8d3fb-bd2a-53ba-b89d-925dd2df308a','cucumber','M6','','','',NULL,NULL,NULL,NULL,NULL,1.0,0.0,0.0,0.0,0.0,0.5,0.22,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,NULL,0.2,0.03);
CREATE TABLE images (
	sha256 TEXT NOT NULL, 
	suffix TEXT NOT NULL, 
	size_bytes INTEGER NOT NULL, 
	width_px INTEGER NOT NULL, 
	height_px INTEGER NOT NULL, 
	CONSTRAINT pk_images PRIMARY KEY (sha256)
);
CREATE TABLE links (
	id INTEGER NOT NULL, 
	first_id INTEGER NOT NULL, 
	second_id INTEGER NOT NULL, 
	first_round_id INTEGER NOT NULL, 
	second_round_id INTEGER NOT NULL, 
	action_id INTEGER, 
	ended_by_id INTEGER, 
	kind TEXT NOT NULL, 
	score DOUBLE, 
	CONSTRAINT pk_links PRIMARY KEY (id), 
	CONSTRAINT fk_links_first_id_fruit FOREIGN KEY(first_id) REFERENCES fruit (id), 
	CONSTRAINT fk_links_second_id_fruit FOREIGN KEY(second_id) REFERENCES fruit (id), 
	CONSTRAINT fk_links_first_round_id_rounds FOREIGN KEY(first_round_id) REFERENCES rounds (id), 
	CONSTRAINT fk_links_second_round_id_rounds FOREIGN KEY(second_round_id) REFERENCES rounds (id), 
	CONSTRAINT fk_links_action_id_actions FOREIGN KEY(action_id) REFERENCES actions (id), 
	CONSTRAINT fk_links_ended_by_id_actions FOREIGN KEY(ended_by_id) REFERENCES actions (id), 
	CONSTRAINT ck_links_ck_links_two CHECK (first_id <> second_id)
);
INSERT INTO "links" VALUES(1,2,3,1,1,2,NULL,'same',NULL);
CREATE TABLE marks (
	id INTEGER NOT NULL, 
	fruit_id INTEGER NOT NULL, 
	action_id INTEGER NOT NULL, 
	ended_by_id INTEGER, 
	slot TEXT NOT NULL, 
	value TEXT NOT NULL, 
	details JSON NOT NULL, 
	CONSTRAINT pk_marks PRIMARY KEY (id), 
	CONSTRAINT fk_marks_fruit_id_fruit FOREIGN KEY(fruit_id) REFERENCES fruit (id), 
	CONSTRAINT fk_marks_action_id_actions FOREIGN KEY(action_id) REFERENCES actions (id), 
	CONSTRAINT fk_marks_ended_by_id_actions FOREIGN KEY(ended_by_id) REFERENCES actions (id)
);
INSERT INTO "marks" VALUES(1,1,1,NULL,'verdict','rejected','{}');
CREATE TABLE masks (
	fruit_id INTEGER NOT NULL, 
	rle TEXT, 
	keypoints JSON NOT NULL, 
	CONSTRAINT pk_masks PRIMARY KEY (fruit_id), 
	CONSTRAINT fk_masks_fruit_id_fruit FOREIGN KEY(fruit_id) REFERENCES fruit (id)
);
INSERT INTO "masks" VALUES(1,'123','[[1.0, 2.0, 0.9]]');
INSERT INTO "masks" VALUES(2,'123','[[1.0, 2.0, 0.9]]');
INSERT INTO "masks" VALUES(3,'123','[[1.0, 2.0, 0.9]]');
INSERT INTO "masks" VALUES(4,'123','[[1.0, 2.0, 0.9]]');
CREATE TABLE measurements (
	fruit_id INTEGER NOT NULL, 
	number INTEGER NOT NULL, 
	method TEXT NOT NULL, 
	kind TEXT, 
	reason TEXT NOT NULL, 
	fallback TEXT NOT NULL, 
	measured_by TEXT, 
	length_m DOUBLE, 
	centreline_m DOUBLE, 
	thread_m DOUBLE, 
	chord_m DOUBLE, 
	centreline_sd_m DOUBLE, 
	thread_sd_m DOUBLE, 
	path_um BLOB NOT NULL, 
	diameter_um BLOB NOT NULL, 
	CONSTRAINT pk_measurements PRIMARY KEY (fruit_id, number), 
	CONSTRAINT fk_measurements_fruit_id_fruit FOREIGN KEY(fruit_id) REFERENCES fruit (id)
);
INSERT INTO "measurements" VALUES(1,0,'M1',NULL,'ok','',NULL,0.2,NULL,NULL,NULL,NULL,NULL,X'',X'');
INSERT INTO "measurements" VALUES(1,1,'M6',NULL,'ok','',NULL,0.25,NULL,0.27,NULL,NULL,NULL,X'00000000A086010020A10700400D0300A086010020A10700',X'409C000050C30000');
INSERT INTO "measurements" VALUES(2,0,'M1',NULL,'ok','',NULL,0.2,NULL,NULL,NULL,NULL,NULL,X'',X'');
INSERT INTO "measurements" VALUES(2,1,'M6',NULL,'ok','',NULL,0.25,NULL,0.27,NULL,NULL,NULL,X'00000000A086010020A10700400D0300A086010020A10700',X'409C000050C30000');
INSERT INTO "measurements" VALUES(3,0,'M1',NULL,'ok','',NULL,0.2,NULL,NULL,NULL,NULL,NULL,X'',X'');
INSERT INTO "measurements" VALUES(3,1,'M6',NULL,'ok','',NULL,0.25,NULL,0.27,NULL,NULL,NULL,X'00000000A086010020A10700400D0300A086010020A10700',X'409C000050C30000');
INSERT INTO "measurements" VALUES(4,0,'M1',NULL,'ok','',NULL,0.2,NULL,NULL,NULL,NULL,NULL,X'',X'');
INSERT INTO "measurements" VALUES(4,1,'M6',NULL,'ok','',NULL,0.25,NULL,0.27,NULL,NULL,NULL,X'00000000A086010020A10700400D0300A086010020A10700',X'409C000050C30000');
CREATE TABLE rounds (
	id INTEGER NOT NULL, 
	"key" TEXT NOT NULL, 
	name TEXT NOT NULL, 
	house TEXT NOT NULL, 
	profile TEXT NOT NULL, 
	note TEXT NOT NULL, 
	started_s DOUBLE NOT NULL, 
	CONSTRAINT pk_rounds PRIMARY KEY (id), 
	CONSTRAINT uq_rounds_key UNIQUE ("key")
);
INSERT INTO "rounds" VALUES(1,'1dc42ef2-cef1-51f2-9330-8fd0b5fedafa','morning','house 1','long-cucumber','',1000.0);
CREATE TABLE rows (
	id INTEGER NOT NULL, 
	house TEXT NOT NULL, 
	name TEXT NOT NULL, 
	CONSTRAINT pk_rows PRIMARY KEY (id), 
	CONSTRAINT uq_rows_house_name UNIQUE (house, name)
);
INSERT INTO "rows" VALUES(1,'house 1','3');
CREATE TABLE shifts (
	row_id INTEGER NOT NULL, 
	earlier_id INTEGER NOT NULL, 
	later_id INTEGER NOT NULL, 
	shift_m DOUBLE NOT NULL, 
	sd_m DOUBLE, 
	CONSTRAINT pk_shifts PRIMARY KEY (row_id, earlier_id, later_id), 
	CONSTRAINT fk_shifts_row_id_rows FOREIGN KEY(row_id) REFERENCES rows (id), 
	CONSTRAINT fk_shifts_earlier_id_rounds FOREIGN KEY(earlier_id) REFERENCES rounds (id), 
	CONSTRAINT fk_shifts_later_id_rounds FOREIGN KEY(later_id) REFERENCES rounds (id)
);
CREATE TABLE stop_artifacts (
	stop_id INTEGER NOT NULL, 
	number INTEGER NOT NULL, 
	artifact_id INTEGER NOT NULL, 
	CONSTRAINT pk_stop_artifacts PRIMARY KEY (stop_id, number), 
	CONSTRAINT fk_stop_artifacts_stop_id_stops FOREIGN KEY(stop_id) REFERENCES stops (id), 
	CONSTRAINT fk_stop_artifacts_artifact_id_artifacts FOREIGN KEY(artifact_id) REFERENCES artifacts (id)
);
INSERT INTO "stop_artifacts" VALUES(1,0,1);
INSERT INTO "stop_artifacts" VALUES(2,0,1);
CREATE TABLE stops (
	id INTEGER NOT NULL, 
	round_id INTEGER NOT NULL, 
	row_id INTEGER, 
	step INTEGER, 
	"key" TEXT NOT NULL, 
	content_sha256 TEXT NOT NULL, 
	side TEXT, 
	note TEXT NOT NULL, 
	position_m DOUBLE, 
	position_sd_m DOUBLE, 
	taken_s DOUBLE NOT NULL, 
	fitted_m DOUBLE, 
	fitted_sd_m DOUBLE, 
	pose JSON NOT NULL, 
	failures JSON NOT NULL, 
	CONSTRAINT pk_stops PRIMARY KEY (id), 
	CONSTRAINT fk_stops_round_id_rounds FOREIGN KEY(round_id) REFERENCES rounds (id), 
	CONSTRAINT fk_stops_row_id_rows FOREIGN KEY(row_id) REFERENCES rows (id), 
	CONSTRAINT uq_stops_key UNIQUE ("key")
);
INSERT INTO "stops" VALUES(1,1,1,0,'3fcddafa-81e9-54ef-8a45-c98f64836457','211500403a28878d2311ffff32a36e9a2b8d1764759172feb55355330a95748c','left','',0.0,0.04,1000.0,NULL,NULL,'[]','[{"capture": "b", "error": "CaptureError"}]');
INSERT INTO "stops" VALUES(2,1,1,1,'f1cf13f2-94af-56e2-9452-54cc3329edaf','1f7cd2c1bf06905d8b2e0140e5be2a972dd626689309b538dce93e9c17cc432e','left','',0.4,0.04,1001.0,NULL,NULL,'[]','[{"capture": "b", "error": "CaptureError"}]');
CREATE INDEX ix_rounds_started_s ON rounds (started_s);
CREATE INDEX ix_stops_round_id ON stops (round_id);
CREATE INDEX ix_stops_row_id ON stops (row_id);
CREATE INDEX ix_actions_round_id ON actions (round_id);
CREATE INDEX ix_stop_artifacts_artifact_id ON stop_artifacts (artifact_id);
CREATE INDEX ix_captures_thumbnail_sha256 ON captures (thumbnail_sha256);
CREATE INDEX ix_captures_color_sha256 ON captures (color_sha256);
CREATE INDEX ix_captures_depth_sha256 ON captures (depth_sha256);
CREATE INDEX ix_fruit_round_id ON fruit (round_id);
CREATE UNIQUE INDEX uq_marks_active ON marks (fruit_id, slot) WHERE ended_by_id IS NULL;
CREATE INDEX ix_marks_action_id ON marks (action_id);
CREATE INDEX ix_marks_ended_by_id ON marks (ended_by_id);
CREATE INDEX ix_marks_fruit_id ON marks (fruit_id);
CREATE INDEX ix_links_ended_by_id ON links (ended_by_id);
CREATE UNIQUE INDEX uq_links_active ON links (first_id, second_id) WHERE ended_by_id IS NULL;
CREATE INDEX ix_links_second_id ON links (second_id);
CREATE INDEX ix_links_second_round_id ON links (second_round_id);
CREATE INDEX ix_links_action_id ON links (action_id);
CREATE INDEX ix_links_first_round_id ON links (first_round_id);
CREATE TRIGGER actions_no_update BEFORE UPDATE ON actions BEGIN SELECT RAISE(ABORT, 'the log is only added to'); END;
CREATE TRIGGER actions_no_delete BEFORE DELETE ON actions BEGIN SELECT RAISE(ABORT, 'the log is only added to'); END;
COMMIT;
