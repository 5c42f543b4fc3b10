"""ECG files of three kinds, written by independent libraries, are read or refused with a reason."""

from __future__ import annotations

import importlib
import re
import warnings

import numpy as np
import pydicom
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sequence import Sequence
from pydicom.uid import ExplicitVRBigEndian, ExplicitVRLittleEndian

from pipeline.errors import InputError
from pipeline.imaging.ecg import other_patient, patient_mark, read_ecg

RATE_HZ = 250.0
# Every value is a whole number of the 1 microvolt steps of the files below.
STEPS_UV = np.random.default_rng(0).integers(-2000, 2000, size=(1000, 2))


def write_wfdb(folder, units="mV", signal=None, name="rec", gain=1000.0):
    signal = STEPS_UV / 1000.0 if signal is None else signal
    channels = signal.shape[1]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        importlib.import_module("wfdb").wrsamp(
            name,
            fs=RATE_HZ,
            units=[units] * channels,
            sig_name=["I", "II"][:channels],
            p_signal=signal,
            fmt=["16"] * channels,
            adc_gain=[gain] * channels,
            baseline=[0] * channels,
            write_dir=str(folder),
        )
    return folder / name


def write_csv(path, signal=None, times_s=None, header="time_s,I,II"):
    signal = STEPS_UV / 1000.0 if signal is None else signal
    times_s = np.arange(len(signal)) / RATE_HZ if times_s is None else times_s
    rows = [
        ",".join([f"{t:.6f}", *(f"{v:.3f}" for v in row)])
        for t, row in zip(times_s, signal, strict=True)
    ]
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def coded(value, meaning):
    item = Dataset()
    item.CodeValue, item.CodingSchemeDesignator, item.CodeMeaning = value, "UCUM", meaning
    return Sequence([item])


def channel(name, unit):
    item = Dataset()
    item.ChannelSourceSequence = coded("2:1", f"Lead {name}")
    item.ChannelSensitivity = "1"
    item.ChannelSensitivityUnitsSequence = coded(unit, "voltage")
    item.ChannelSensitivityCorrectionFactor = "1"
    item.ChannelBaseline = "0"
    item.WaveformBitsStored = 16
    return item


def waveform_group(steps, unit):
    group = Dataset()
    group.WaveformOriginality = "ORIGINAL"
    group.NumberOfWaveformChannels = steps.shape[1]
    group.NumberOfWaveformSamples = len(steps)
    group.SamplingFrequency = str(RATE_HZ)
    group.WaveformBitsAllocated = 16
    group.WaveformSampleInterpretation = "SS"
    names = ("I", "II")[: steps.shape[1]]
    group.ChannelDefinitionSequence = Sequence([channel(n, unit) for n in names])
    group.WaveformData = steps.astype("<i2").tobytes()
    return group


def write_dicom(path, groups=None, unit="uV"):
    dataset = Dataset()
    dataset.file_meta = FileMetaDataset()
    dataset.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    dataset.SOPClassUID = pydicom.uid.TwelveLeadECGWaveformStorage
    dataset.SOPInstanceUID = "1.2.3"
    if groups != []:
        dataset.WaveformSequence = Sequence(groups or [waveform_group(STEPS_UV, unit)])
    dataset.save_as(path, enforce_file_format=True)
    return path


@pytest.mark.parametrize("suffix", ["", ".hea", ".dat"])
def test_wfdb_record_is_named_by_stem_or_by_either_file(tmp_path, suffix):
    stem = write_wfdb(tmp_path)
    ecg = read_ecg(stem.with_name(stem.name + suffix))
    np.testing.assert_allclose(ecg.signal_mv, STEPS_UV / 1000.0, rtol=0, atol=1e-9)
    assert (ecg.leads, ecg.sampling_rate_hz, ecg.start_s) == (("I", "II"), RATE_HZ, 0.0)


@pytest.mark.parametrize(("unit", "millivolts"), [("mV", 1.0), ("uV", 1e-3), ("V", 1e3)])
def test_wfdb_units_become_millivolts(tmp_path, unit, millivolts):
    stem = write_wfdb(tmp_path, units=unit)
    expected = STEPS_UV / 1000.0 * millivolts
    np.testing.assert_allclose(read_ecg(stem).signal_mv, expected, rtol=1e-9)


@pytest.mark.parametrize("sign", ["\xb5V".encode("latin-1"), "\xb5V".encode(), "\u03bcV".encode()])
def test_a_micro_sign_is_told_before_microvolts_are_taken_for_volts(tmp_path, sign):
    stem = write_wfdb(tmp_path, units="uV")
    header = stem.with_name(stem.name + ".hea")
    header.write_bytes(header.read_bytes().replace(b"uV", sign))
    with pytest.raises(InputError, match=r"micro sign.*write uV"):
        read_ecg(stem)
    with_segments = stem.with_name("whole.hea")
    with_segments.write_text(f"whole/1 2 {RATE_HZ} 1000\n{stem.name} 1000\n")
    with pytest.raises(InputError, match=r"micro sign.*write uV"):
        read_ecg(with_segments)
    # Elsewhere the same bytes are letters.
    named = (
        header.read_bytes().replace(sign, b"uV").replace(b" I\n", b" I \xe5\xbf\x83\xe7\x94\xb5\n")
    )
    header.write_bytes(named + b"# by M\xc3\xb5ller\n")
    np.testing.assert_allclose(read_ecg(stem).signal_mv, STEPS_UV / 1e6, rtol=1e-9)


def test_csv_starts_at_its_first_time(tmp_path):
    path = write_csv(tmp_path / "ecg.csv", times_s=12.5 + np.arange(1000) / RATE_HZ)
    ecg = read_ecg(path)
    np.testing.assert_allclose(ecg.signal_mv, STEPS_UV / 1000.0, rtol=0, atol=1e-9)
    assert ecg.start_s == 12.5
    # Times are written to the microsecond over 4 s.
    assert ecg.sampling_rate_hz == pytest.approx(RATE_HZ, rel=1e-6 / 3.9)


@given(rate_hz=st.floats(100.0, 800.0), start_s=st.floats(0.0, 1e4))
def test_csv_times_rounded_to_milliseconds_are_still_even(tmp_path_factory, rate_hz, start_s):
    folder = tmp_path_factory.mktemp("csv")
    times_s = np.round(start_s + np.arange(300) / rate_hz, 3)
    path = write_csv(folder / "ecg.csv", signal=STEPS_UV[:300] / 1000.0, times_s=times_s)
    # Rounding moves each time by half a millisecond at most; the slope of a line through n points
    # moves by at most 1.5 / (n - 1) of that on either side, when one half is early, the other late.
    assert read_ecg(path).sampling_rate_hz == pytest.approx(rate_hz, rel=1.6e-3 * rate_hz / 299)


def test_dicom_waveform_is_read_in_millivolts(tmp_path):
    ecg = read_ecg(write_dicom(tmp_path / "ecg.dcm"))
    np.testing.assert_allclose(ecg.signal_mv, STEPS_UV / 1000.0, rtol=0, atol=1e-9)
    assert (ecg.leads, ecg.sampling_rate_hz) == (("I", "II"), RATE_HZ)


def test_an_ecg_of_another_patient_than_the_cine_is_told(tmp_path):
    path = write_dicom(tmp_path / "ecg.dcm")
    assert other_patient(read_ecg(path), patient_mark("4711"), path) == []
    with pydicom.dcmread(path) as dataset:
        dataset.PatientID = " 4712"
        dataset.save_as(tmp_path / "named.dcm")
    named = read_ecg(tmp_path / "named.dcm")
    for mark in (patient_mark("4712"), patient_mark("")):
        assert other_patient(named, mark, path) == []
    [told] = other_patient(named, patient_mark("4711"), path)
    assert told.startswith(f"{path} has another PatientID than the cine: make sure")
    # Reports are shown to others.
    assert "471" not in told.removeprefix(str(path)) + patient_mark("4711")


def test_dicom_samples_that_stand_for_none_are_a_gap(tmp_path):
    steps = STEPS_UV.copy()
    steps[300:320, 1] = -32768
    group = waveform_group(steps, "uV")
    group.WaveformPaddingValue = b"\x00\x80"
    path = write_dicom(tmp_path / "ecg.dcm", [group])
    with pytest.raises(InputError, match="lead II: 20 of 1000 samples are not a number"):
        read_ecg(path)
    found_mv = read_ecg(path, gaps=True).signal_mv
    np.testing.assert_array_equal(np.isnan(found_mv), steps == -32768)
    # Zero is a voltage, whatever a file says.
    group.WaveformPaddingValue = b"\x00\x00"
    assert np.isfinite(read_ecg(write_dicom(tmp_path / "zero.dcm", [group])).signal_mv).all()


def test_dicom_recording_is_preferred_to_the_averaged_beat(tmp_path):
    beat = waveform_group(STEPS_UV[:200, :1], "uV")
    whole = waveform_group(STEPS_UV, "uV")
    assert len(read_ecg(write_dicom(tmp_path / "ecg.dcm", [beat, whole])).signal_mv) == 1000


@pytest.mark.parametrize("name", ["ecg", "ecg.hea", "ecg.csv", "ecg.dcm"])
def test_missing_file_is_named(tmp_path, name):
    with pytest.raises(InputError, match=r"ecg.*no such"):
        read_ecg(tmp_path / name)


def test_signals_without_a_name_or_a_gain_are_read(tmp_path):
    """The WFDB library's manual, header(5): a record may tell its files and formats alone, and is
    then taken for one of 200 steps a millivolt."""
    steps = np.random.default_rng(2).integers(-900, 900, (2000, 2)).astype("<i2")
    (tmp_path / "bare.dat").write_bytes(steps.tobytes())
    (tmp_path / "bare.hea").write_text("bare 2 360 2000\nbare.dat 16\nbare.dat 16\n")
    ecg = read_ecg(tmp_path / "bare")
    assert ecg.leads == ("signal 1", "signal 2")
    np.testing.assert_allclose(ecg.signal_mv, steps / 200)


def test_truncated_wfdb_signal_is_refused(tmp_path):
    stem = write_wfdb(tmp_path)
    data = stem.with_suffix(".dat")
    data.write_bytes(data.read_bytes()[:-700])
    with pytest.raises(InputError, match="WFDB"):
        read_ecg(stem)


def test_wfdb_header_without_signal_is_refused(tmp_path):
    stem = write_wfdb(tmp_path)
    stem.with_suffix(".dat").unlink()
    with pytest.raises(InputError, match=r"rec\.hea.*\.dat"):
        read_ecg(stem)


@pytest.mark.parametrize("content", ["", "not a header at all", "rec two 250 1000\n"])
def test_damaged_wfdb_header_is_refused(tmp_path, content):
    stem = write_wfdb(tmp_path)
    stem.with_suffix(".hea").write_text(content)
    with pytest.raises(InputError, match=r"rec\.hea"):
        read_ecg(stem)


def test_truncated_dicom_waveform_is_refused(tmp_path):
    group = waveform_group(STEPS_UV, "uV")
    group.WaveformData = group.WaveformData[:-700]
    with pytest.raises(InputError, match="cannot be decoded"):
        read_ecg(write_dicom(tmp_path / "ecg.dcm", [group]))


@pytest.mark.parametrize("name", ["NumberOfWaveformSamples", "SamplingFrequency"])
@pytest.mark.parametrize("empty", [True, False])
def test_a_dicom_waveform_without_what_tells_its_times_is_refused(tmp_path, name, empty):
    group = waveform_group(STEPS_UV, "uV")
    setattr(group, name, None) if empty else delattr(group, name)
    with pytest.raises(InputError, match="cannot be decoded"):
        read_ecg(write_dicom(tmp_path / "ecg.dcm", [group]))


def test_truncated_dicom_file_is_refused(tmp_path):
    path = write_dicom(tmp_path / "ecg.dcm")
    path.write_bytes(path.read_bytes()[:-700])
    with pytest.raises(InputError, match=r"ecg\.dcm"):
        read_ecg(path)


def test_dicom_without_waveform_is_refused(tmp_path):
    with pytest.raises(InputError, match="WaveformSequence"):
        read_ecg(write_dicom(tmp_path / "ecg.dcm", []))


def test_file_of_no_known_kind_is_refused(tmp_path):
    (tmp_path / "ecg.xyz").write_text("hello")
    with pytest.raises(InputError, match="neither a WFDB record"):
        read_ecg(tmp_path / "ecg.xyz")


@pytest.mark.parametrize("kind", ["wfdb", "csv"])
def test_missing_samples_are_counted_by_lead(tmp_path, kind):
    signal = STEPS_UV / 1000.0
    signal[100:130, 1] = np.nan
    write = {"wfdb": lambda: write_wfdb(tmp_path, signal=signal)}
    write["csv"] = lambda: write_csv(tmp_path / "ecg.csv", signal=signal)
    with pytest.raises(InputError, match="lead II: 30 of 1000"):
        read_ecg(write[kind]())


def test_every_constant_lead_is_named(tmp_path):
    with pytest.raises(InputError, match=r"lead I: constant.*lead II: constant"):
        read_ecg(write_csv(tmp_path / "ecg.csv", signal=np.full((100, 2), 0.5)))


@pytest.mark.parametrize("kind", ["wfdb", "dicom"])
def test_unit_that_is_no_voltage_is_refused(tmp_path, kind):
    path = write_wfdb(tmp_path, units="mmHg") if kind == "wfdb" else None
    path = path or write_dicom(tmp_path / "ecg.dcm", unit="mm[Hg]")
    with pytest.raises(
        InputError, match=r"channel 'I' is in 'mm.*voltage.*: take it out, for press"
    ):
        read_ecg(path)


@pytest.mark.parametrize("unit", ["adu", "1"])
def test_a_lead_that_was_not_calibrated_is_no_pressure(tmp_path, unit):
    with pytest.raises(InputError, match=r"not calibrated, write mV: its scale changes no R peak"):
        read_ecg(write_wfdb(tmp_path, units=unit))


def test_csv_gap_is_refused(tmp_path):
    times_s = np.arange(1000) / RATE_HZ
    times_s[600:] += 1 / RATE_HZ
    with pytest.raises(InputError, match=r"not evenly spaced: 0\.008 s after 2\.396"):
        read_ecg(write_csv(tmp_path / "ecg.csv", times_s=times_s))


def test_csv_change_of_rate_is_refused(tmp_path):
    times_s = np.cumsum(np.where(np.arange(1000) < 500, 0.004, 0.005))
    with pytest.raises(InputError, match="not evenly spaced"):
        read_ecg(write_csv(tmp_path / "ecg.csv", times_s=times_s))


@pytest.mark.parametrize("rows", [(10, 11), (10, 700)])
def test_csv_time_running_back_is_refused(tmp_path, rows):
    times_s = np.arange(1000) / RATE_HZ
    times_s[list(rows)] = times_s[list(rows)[::-1]]
    with pytest.raises(InputError, match=r"does not rise.*sort the rows"):
        read_ecg(write_csv(tmp_path / "ecg.csv", times_s=times_s))


def test_csv_rows_in_any_order_are_to_be_sorted(tmp_path):
    times_s = np.random.default_rng(0).permutation(1000) / RATE_HZ
    with pytest.raises(InputError, match="sort the rows"):
        read_ecg(write_csv(tmp_path / "ecg.csv", times_s=times_s))


@pytest.mark.parametrize("rate_hz", [1000.0, 2000.0])
def test_csv_times_that_jitter_are_not_called_unsorted(tmp_path, rate_hz):
    """0.4 ms, as of a computer that stamps samples when it gets them."""
    times_s = np.arange(1000) / rate_hz + 0.4e-3 * np.random.default_rng(0).normal(size=1000)
    with pytest.raises(InputError, match=r"ecg\.csv: time_s scatters by up to 1\.\d+ ms") as told:
        read_ecg(write_csv(tmp_path / "ecg.csv", times_s=times_s))
    assert "sort" not in str(told.value)
    assert f"even grid of {1e3 / rate_hz:.3g} ms" in str(told.value)


def test_csv_samples_that_were_stamped_in_blocks_are_told(tmp_path):
    times_s = np.arange(1000) // 20 * 20 / RATE_HZ
    with pytest.raises(InputError, match="scatters by up to"):
        read_ecg(write_csv(tmp_path / "ecg.csv", times_s=times_s))


def test_csv_row_that_stands_twice_is_told(tmp_path):
    times_s = np.delete(np.arange(1001), 500) / RATE_HZ
    times_s[500] = times_s[499]
    with pytest.raises(InputError, match=r"line 502\); take one of the two rows out"):
        read_ecg(write_csv(tmp_path / "ecg.csv", times_s=times_s))


@pytest.mark.parametrize("back_s", [0.1, 0.3, 86400.0])
def test_csv_clock_that_was_set_back_is_mended_by_adding_what_is_told(tmp_path, back_s):
    """By NTP, or at midnight; sorted rows would make another heart of it."""
    times_s = 86398.0 + np.arange(1000) / RATE_HZ
    set_back = np.where(np.arange(1000) < 500, times_s, times_s - back_s)
    with pytest.raises(InputError, match=rf"line 502\); .* add {back_s:g} s") as told:
        read_ecg(write_csv(tmp_path / "ecg.csv", times_s=set_back))
    added_s = float(re.search(r"add (\S+) s", str(told.value))[1])
    set_back[500:] += added_s
    mended = read_ecg(write_csv(tmp_path / "mended.csv", times_s=set_back))
    assert mended.sampling_rate_hz == pytest.approx(RATE_HZ, rel=1e-6)


def test_csv_gap_of_an_hour_is_no_other_unit(tmp_path):
    times_s = np.arange(1000) / RATE_HZ
    times_s[500:] += 3600
    with pytest.raises(InputError, match="not evenly spaced"):
        read_ecg(write_csv(tmp_path / "ecg.csv", times_s=times_s))


@pytest.mark.parametrize(("unit", "count"), [("milliseconds", 1000), ("microseconds", 1_000_000)])
@pytest.mark.parametrize("rate_hz", [128.0, 500.0, 2000.0])
def test_csv_times_in_another_unit_are_told(tmp_path, unit, count, rate_hz):
    path = write_csv(tmp_path / "ecg.csv", times_s=count * np.arange(1000) / rate_hz)
    words = rf"ecg\.csv: time_s rises by .* is it in {unit} \({rate_hz:g} .* divide it by {count}"
    with pytest.raises(InputError, match=words):
        read_ecg(path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "first row"),
        ("t,I\n0,1\n", "first row"),
        ("time_s,I\n", "2 or more"),
        ("time_s,I\n0,1\n0.1,x\n", "line 3"),
        ("time_s,I\n0,1\n0.1,1,2\n", "line 3"),
        ("time_s,I\n0,1\n0.1,2\n0.2", "line 4"),
        ("time_s,I\n0,1\nnan,2\n0.2,3\n", "line 3: .* no number is in cell 1;"),
        ("time_s,I\n0,1\n0.1,inf\n", "line 3: .* no number is in cell 2;"),
        ("time_s,I\n0,1\n0.1,\n", "write nan"),
        ("time_s,I\n0,000,0,012\n", "write points"),
        ("time_s;I\n0;1\n", "not by semicolons"),
        ("time_s\tI\n0\t1\n", "not by tabs"),
        ("# of a monitor\ntime_s,I\n0,1\n", "comments"),
        ('"time (s)",I\n0,1\n', "call the first column time_s"),
        ("time_s,I (uV)\n0,1\n0.1,2\n", "is in uV"),
    ],
)
def test_malformed_csv_is_refused_with_the_place(tmp_path, text, words):
    (tmp_path / "ecg.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        read_ecg(tmp_path / "ecg.csv")


def test_a_csv_of_windows_is_told_by_its_micro_sign(tmp_path):
    path = write_csv(tmp_path / "ecg.csv")
    for text, encoding in (("I (µV)", "cp1252"), ("I (µV)", "utf-8"), ("I_uV", "utf-8")):
        path.write_bytes(
            path.read_bytes().replace(b"time_s,I,", f"time_s,{text},".encode(encoding))
        )
        with pytest.raises(InputError, match=r"is in [µu]V; .*: write the values so, and \(mV\)"):
            read_ecg(path)
        write_csv(path)


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("s,mV,mV", "delete it if it gives units"),
        ('"0.004","0.1","0.1"', "mend it"),
        ("12:00:00.000,0.1,0.1", "write times as seconds"),
        (",,", "delete it, and all behind it, if the recording ends there"),
    ],
)
def test_what_a_line_of_a_csv_lacks_is_told(tmp_path, line, told):
    path = write_csv(tmp_path / "ecg.csv", header=f"time_s,I,II\n{line}")
    with pytest.raises(InputError, match=rf"line 2: needs 3 numbers.*; {told}"):
        read_ecg(path)


@pytest.mark.parametrize("header", ["Patient: {};13.07.1941", "{},I", "time_s,I\n0,0.1\n0.1,{}"])
def test_a_patient_named_in_a_csv_is_not_repeated(tmp_path, header):
    """Refusals are kept in run.json and in the table of a batch."""
    (tmp_path / "ecg.csv").write_text(header.format("Hildegard") + "\n0.2,1\n0.3,1\n")
    with pytest.raises(InputError, match=r"ecg\.csv") as refusal:
        read_ecg(tmp_path / "ecg.csv")
    assert "Hildegard" not in str(refusal.value)


def test_csv_in_utf_16_is_refused_with_the_remedy(tmp_path):
    (tmp_path / "ecg.csv").write_text("time_s,I\n0,1\n", encoding="utf-16-le")
    with pytest.raises(InputError, match="save it as UTF-8"):
        read_ecg(tmp_path / "ecg.csv")


def test_names_of_leads_are_no_units(tmp_path):
    lines = [f"{k / 250:.3f},{k % 7},{k % 5}" for k in range(1000)]
    (tmp_path / "ecg.csv").write_text("\n".join(["time_s,I (mV),lead (II)", *lines]))
    assert read_ecg(tmp_path / "ecg.csv").leads == ("I (mV)", "lead (II)")


@pytest.mark.parametrize("name", ["ABP (mmHg)", "Resp (Ohm)", "II (NU)", "II [counts]", "x (1)"])
def test_a_csv_column_that_is_no_voltage_is_refused(tmp_path, name):
    """It has beats of its own, later than those of the heart's electricity."""
    with pytest.raises(InputError, match=r"is in .* millivolts of an ECG: take the col"):
        read_ecg(write_csv(tmp_path / "ecg.csv", header=f"time_s,I,{name}"))


@pytest.mark.parametrize("name", ["lead (aVR)", "ECG [V5]", "ml (MLII)", "I (mV)", "I ()"])
def test_a_lead_in_brackets_is_no_unit(tmp_path, name):
    assert read_ecg(write_csv(tmp_path / "ecg.csv", header=f"time_s,I,{name}")).leads[1] == name


def test_segments_in_other_units_or_with_a_gap_are_refused(tmp_path):
    for name, unit in (("one", "mV"), ("two", "uV"), ("three", "mV")):
        write_wfdb(tmp_path, units=unit, name=name)
    whole = tmp_path / "whole.hea"
    whole.write_text(f"whole/2 2 {RATE_HZ} 2000\none 1000\nthree 1000\n")
    assert read_ecg(whole).signal_mv.shape == (2000, 2)
    whole.write_text(f"whole/2 2 {RATE_HZ} 2000\none 1000\ntwo 1000\n")
    with pytest.raises(InputError, match="segments give one signal in different units"):
        read_ecg(whole)
    whole.write_text(f"whole/3 2 {RATE_HZ} 2100\none 1000\n~ 100\nthree 1000\n")
    with pytest.raises(InputError, match=r"a gap between its segments \(~\)"):
        read_ecg(whole)


def test_a_length_that_is_no_number_is_refused(tmp_path):
    group = waveform_group(STEPS_UV, "uV")
    group.SamplingFrequency = [str(RATE_HZ), str(RATE_HZ)]
    with pytest.raises(InputError, match="how long its waveforms are cannot be understood"):
        read_ecg(write_dicom(tmp_path / "ecg.dcm", [group]))


def test_of_groups_of_channels_the_longest_of_voltages_is_read(tmp_path):
    """A pressure beside it has more samples."""
    pressure = waveform_group(np.concatenate([STEPS_UV, STEPS_UV])[:, :1], "mm[Hg]")
    averaged = waveform_group(STEPS_UV[:400], "uV")
    averaged.SamplingFrequency = str(RATE_HZ / 2)
    groups = [pressure, averaged, waveform_group(STEPS_UV, "uV")]
    ecg = read_ecg(write_dicom(tmp_path / "ecg.dcm", groups))
    np.testing.assert_allclose(ecg.signal_mv, STEPS_UV / 1000.0)


def test_a_group_that_begins_later_than_its_record_has_its_own_start(tmp_path):
    group = waveform_group(STEPS_UV, "uV")
    assert read_ecg(write_dicom(tmp_path / "ecg.dcm", [group])).start_s == 0
    group.MultiplexGroupTimeOffset = "1250"
    assert read_ecg(write_dicom(tmp_path / "ecg.dcm", [group])).start_s == 1.25


def test_nanovolts_become_millivolts(tmp_path):
    stem = write_wfdb(tmp_path, units="nV")
    np.testing.assert_allclose(read_ecg(stem).signal_mv, STEPS_UV / 1000.0 * 1e-6, rtol=1e-9)


def write_frames(folder, each, name="frames", skew=""):
    """A record of format 16 by the text of the WFDB guide: each frame holds some samples of I, of
    II, and one of a pressure."""
    per_i, per_ii = each
    frames = len(STEPS_UV) // max(each)
    lead_i = STEPS_UV[:: max(each) // per_i, 0].reshape(frames, per_i)
    lead_ii = STEPS_UV[:: max(each) // per_ii, 1].reshape(frames, per_ii)
    stored = np.hstack([lead_i, lead_ii, np.arange(frames)[:, None] % 90]).astype("<i2")
    (folder / f"{name}.dat").write_bytes(stored.tobytes())
    lines = [
        f"{name} 3 {RATE_HZ / max(each):g} {frames}",
        f"{name}.dat 16x{per_i}{skew} 1000(0)/mV 16 0 0 0 0 I",
        f"{name}.dat 16x{per_ii} 1000(0)/mV 16 0 0 0 0 II",
        f"{name}.dat 16 1(0)/mmHg 16 0 0 0 0 ABP",
    ]
    (folder / f"{name}.hea").write_text("\n".join(lines) + "\n")
    return folder / name


def test_all_samples_of_a_wfdb_frame_are_read(tmp_path):
    ecg = read_ecg(write_frames(tmp_path, (4, 4)), gaps=True)
    np.testing.assert_allclose(ecg.signal_mv, STEPS_UV / 1000.0, rtol=0, atol=1e-9)
    assert (ecg.leads, ecg.sampling_rate_hz) == (("I", "II"), RATE_HZ)


def test_leads_of_fewer_samples_than_others_are_left_out_or_refused(tmp_path):
    stem = write_frames(tmp_path, (1, 4))
    ecg = read_ecg(stem, gaps=True)
    np.testing.assert_allclose(ecg.signal_mv, STEPS_UV[:, 1:] / 1000.0, rtol=0, atol=1e-9)
    assert (ecg.leads, ecg.sampling_rate_hz) == (("II",), RATE_HZ)
    header = stem.with_suffix(".hea")
    header.write_text(header.read_text().replace("1(0)/mmHg", "1(0)/mV"))
    with pytest.raises(InputError, match=r"leads of different rates: I, ABP of fewer samples"):
        read_ecg(stem)


def test_a_lead_that_was_sampled_late_is_moved_and_the_end_is_cut(tmp_path):
    ecg = read_ecg(write_frames(tmp_path, (1, 1), skew=":5"), gaps=True)
    moved = np.column_stack([STEPS_UV[5:, 0], STEPS_UV[:-5, 1]])
    np.testing.assert_allclose(ecg.signal_mv, moved / 1000.0, rtol=0, atol=1e-9)


def write_big_endian(path, group):
    dataset = Dataset()
    dataset.file_meta = FileMetaDataset()
    dataset.file_meta.TransferSyntaxUID = ExplicitVRBigEndian
    dataset.SOPClassUID = pydicom.uid.TwelveLeadECGWaveformStorage
    dataset.SOPInstanceUID = "1.2.3"
    dataset.WaveformSequence = Sequence([group])
    dataset.save_as(path, enforce_file_format=True)
    return path


def test_a_dicom_waveform_of_the_other_byte_order_is_the_same(tmp_path):
    steps = STEPS_UV.copy()
    steps[7, 0] = -32768
    group = waveform_group(steps, "uV")
    group.WaveformData = steps.astype(">i2").tobytes()
    group.WaveformPaddingValue = b"\x80\x00"
    ecg = read_ecg(write_big_endian(tmp_path / "ecg.dcm", group), gaps=True)
    wanted = np.where(steps == -32768, np.nan, steps / 1000.0)
    np.testing.assert_allclose(ecg.signal_mv, wanted)


def test_a_dicom_waveform_without_preamble_is_read(tmp_path):
    path = write_dicom(tmp_path / "ecg.dcm")
    path.write_bytes(path.read_bytes()[132:])
    np.testing.assert_allclose(read_ecg(path).signal_mv, STEPS_UV / 1000.0)


def test_a_correction_or_a_baseline_that_is_empty_is_none(tmp_path):
    group = waveform_group(STEPS_UV, "uV")
    for one in group.ChannelDefinitionSequence:
        one.ChannelBaseline = one.ChannelSensitivityCorrectionFactor = None
    np.testing.assert_allclose(
        read_ecg(write_dicom(tmp_path / "ecg.dcm", [group])).signal_mv, STEPS_UV / 1000.0
    )


def test_samples_packed_as_telephones_do_are_refused(tmp_path):
    group = waveform_group(STEPS_UV, "uV")
    group.WaveformBitsAllocated, group.WaveformSampleInterpretation = 8, "MB"
    group.WaveformData = (STEPS_UV % 256).astype(np.uint8).tobytes()
    with pytest.raises(InputError, match="packed by mu-law"):
        read_ecg(write_dicom(tmp_path / "ecg.dcm", [group]))


def test_a_channel_of_a_dicom_group_that_is_no_voltage_is_left_out_beside_one(tmp_path):
    group = waveform_group(STEPS_UV, "uV")
    group.ChannelDefinitionSequence[1].ChannelSensitivityUnitsSequence = coded("Ohm", "resistance")
    path = write_dicom(tmp_path / "ecg.dcm", [group])
    ecg = read_ecg(path, gaps=True)
    assert ecg.leads == ("I",)
    np.testing.assert_allclose(ecg.signal_mv, STEPS_UV[:, :1] / 1000.0)
    with pytest.raises(InputError, match="channel 'II' is in 'Ohm'"):
        read_ecg(path)


def test_a_dicom_waveform_of_the_other_byte_order_that_ends_within_a_sample_is_refused(tmp_path):
    group = waveform_group(STEPS_UV, "uV")
    group.WaveformData = STEPS_UV.astype(">i2").tobytes()
    path = write_big_endian(tmp_path / "ecg.dcm", group)
    with pydicom.dcmread(path) as dataset:
        dataset.WaveformSequence[0].WaveformBitsAllocated = 32
        dataset.WaveformSequence[0].WaveformData += b"\0\0"
        dataset.save_as(path)
    with pytest.raises(InputError, match="the waveform cannot be decoded"):
        read_ecg(path)


def test_leads_that_are_constant_where_they_are_no_gap_are_no_ecg(tmp_path):
    steps = np.full(STEPS_UV.shape, 250.0)
    steps[3:9] = np.nan
    with pytest.raises(InputError, match=r"lead II: 6 of \d+ samples are not a number"):
        read_ecg(write_csv(tmp_path / "ecg.csv", steps), gaps=True)
