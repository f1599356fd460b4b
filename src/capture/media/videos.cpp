// Videos with libav: decoding frame by frame, counting, encoding.
extern "C" {
#include <libavcodec/avcodec.h>
#include <libavformat/avformat.h>
#include <libavutil/opt.h>
#include <libswscale/swscale.h>
}

#include <unistd.h>

#include <cmath>
#include <cstring>
#include <limits>
#include <mutex>
#include <new>

#include "src/capture/media.h"

namespace chainsplat::capture::media {

namespace {

struct Free {
  void operator()(AVFormatContext* c) const { avformat_close_input(&c); }
  void operator()(AVCodecContext* c) const { avcodec_free_context(&c); }
  void operator()(AVFrame* f) const { av_frame_free(&f); }
  void operator()(AVPacket* p) const { av_packet_free(&p); }
  void operator()(SwsContext* s) const { sws_freeContext(s); }
};
template <class T>
using Owned = std::unique_ptr<T, Free>;

// Returns a zeroed frame with libav's own padding, because libswscale's vector code reads and writes past the ends of
// rows without padding.
Owned<AVFrame> padded_frame(int width, int height, AVPixelFormat format) {
  Owned<AVFrame> frame(av_frame_alloc());
  frame->width = width;
  frame->height = height;
  frame->format = format;
  if (av_frame_get_buffer(frame.get(), 0) < 0) throw std::bad_alloc();
  for (int plane = 0; plane < AV_NUM_DATA_POINTERS && frame->buf[plane]; ++plane)
    std::memset(frame->buf[plane]->data, 0, frame->buf[plane]->size);
  return frame;
}

// The formats that libav may open, all of which hold their frames themselves. It also knows formats that are lists of
// further files or addresses (HLS, DASH, concat, SDP, ...), and it recognizes a format by its contents, whatever the
// file's name: a file called cam0.mp4 could have it open any other file.
constexpr const char* kContainers =
    "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpeg,mpegts,ogg,flv,asf,h264,hevc,m4v,mpegvideo,obu,ivf,mjpeg,"
    "yuv4mpegpipe";

std::string error_text(int code) {
  char text[AV_ERROR_MAX_STRING_SIZE] = {};
  av_strerror(code, text, sizeof text);
  return text;
}

// Keeps libav from writing to standard error, because the library does not print.
// libav's settings of the whole process: it prints nothing, and a damaged file gets no more memory than a frame needs.
void prepare() {
  constexpr std::size_t kMostAllocation = std::size_t{5} * kMostPixels;  // bytes; a frame has four a pixel at most
  static std::once_flag once;
  std::call_once(once, [] {
    av_log_set_level(AV_LOG_QUIET);
    av_max_alloc(kMostAllocation);
  });
}

// An opened file and the index of its video stream.
struct Opened {
  Owned<AVFormatContext> format;
  int stream = 0;
  const AVStream& video() const { return *format->streams[stream]; }
};

// The mean rate by the stream's header in frames per second, 0 when unknown.
double claimed_rate(const AVStream& video) {
  const AVRational rate = video.avg_frame_rate;
  return rate.num > 0 && rate.den > 0 ? av_q2d(rate) : 0.0;
}

// `pipe`: as in media::VideoLibrary::open.
Opened open_recording(const Path& file, int pipe = -1) {
  std::error_code error;
  if (!std::filesystem::exists(file, error)) throw InputError(file.string(), "does not exist", "check the path");
  AVFormatContext* raw = nullptr;
  AVDictionary* only = nullptr;
  av_dict_set(&only, "format_whitelist", kContainers, 0);
  const std::string protocol = pipe < 0 ? "file" : "pipe";
  av_dict_set(&only, "protocol_whitelist", protocol.c_str(), 0);
  // with the protocol in front, no file name is taken for an address
  const std::string address = protocol + ":" + (pipe < 0 ? file.string() : std::to_string(pipe));
  int code = avformat_open_input(&raw, address.c_str(), nullptr, &only);
  av_dict_free(&only);
  if (code < 0)
    throw InputError(file.string(), "is not a readable video (" + error_text(code) + ")",
                     "write it again as MP4 or MKV, or name an image pattern like cam0/%06d.png");
  Opened opened{Owned<AVFormatContext>(raw), 0};
  code = avformat_find_stream_info(raw, nullptr);
  if (code >= 0) code = av_find_best_stream(raw, AVMEDIA_TYPE_VIDEO, -1, -1, nullptr, 0);
  if (code < 0) throw InputError(file.string(), "has no video stream", "write it again");
  opened.stream = code;
  return opened;
}

bool full_range(const AVFrame& frame) {
  switch (frame.format) {
    case AV_PIX_FMT_YUVJ420P:
    case AV_PIX_FMT_YUVJ422P:
    case AV_PIX_FMT_YUVJ444P:
    case AV_PIX_FMT_YUVJ440P:
      return true;
    default:
      return frame.color_range == AVCOL_RANGE_JPEG;
  }
}

// Returns swscale's number of the color matrix; an untagged stream counts as BT.601. The numbers of AVColorSpace and
// SWS_CS_* are the same.
int matrix(AVColorSpace space) {
  switch (space) {
    case AVCOL_SPC_BT709:
    case AVCOL_SPC_FCC:
    case AVCOL_SPC_SMPTE240M:
    case AVCOL_SPC_BT2020_NCL:
    case AVCOL_SPC_BT2020_CL:
      return space;
    default:
      return SWS_CS_ITU601;
  }
}

}  // namespace

struct Decoder {
  Path file;
  Opened input;
  Owned<AVCodecContext> decoder;
  Owned<AVFrame> frame{av_frame_alloc()};
  Owned<AVPacket> packet{av_packet_alloc()};
  Owned<SwsContext> scaler;
  Owned<AVFrame> converted;
  int scaler_width = 0, scaler_height = 0, scaler_format = -1, scaler_matrix = -1;
  bool scaler_full = false, at_end = false;
  int frames = 0;

  bool decode();
  void convert(Image8& rgb);
};

// Decodes the next frame in display order into `frame`. Returns false at the end.
bool Decoder::decode() {
  for (;;) {
    int code = avcodec_receive_frame(decoder.get(), frame.get());
    if (code >= 0) return true;
    if (code == AVERROR_EOF) return false;
    if (code == AVERROR(EAGAIN) && !at_end) {
      code = av_read_frame(input.format.get(), packet.get());
      if (code == AVERROR_EOF) {
        at_end = true;
        avcodec_send_packet(decoder.get(), nullptr);
        continue;
      }
      if (code >= 0) {
        if (packet->stream_index == input.stream) code = avcodec_send_packet(decoder.get(), packet.get());
        av_packet_unref(packet.get());
      }
    }
    if (code < 0)
      throw InputError(file.string() + ": frame " + std::to_string(frames),
                       "cannot be decoded (" + error_text(code) + ")", "write the video again");
  }
}

// Converts `frame` to RGB.
void Decoder::convert(Image8& rgb) {
  const int width = frame->width, height = frame->height;
  if (width <= 0 || height <= 0 || static_cast<std::int64_t>(width) * height > kMostPixels)
    throw InputError(file.string(),
                     "claims frames of " + std::to_string(width) + "x" + std::to_string(height) + " pixels",
                     "write the video again");
  // make a converter when the format differs from the previous frame's
  const int coefficients = matrix(frame->colorspace);
  const bool full = full_range(*frame);
  if (!scaler || width != scaler_width || height != scaler_height || frame->format != scaler_format ||
      coefficients != scaler_matrix || full != scaler_full) {
    scaler_width = width;
    scaler_height = height;
    scaler_format = frame->format;
    scaler_matrix = coefficients;
    scaler_full = full;
    // exactly the default flags: others move colors at chroma edges by up to 200 levels
    scaler.reset(sws_getContext(width, height, static_cast<AVPixelFormat>(frame->format), width, height,
                                AV_PIX_FMT_RGB24, SWS_BICUBIC, nullptr, nullptr, nullptr));
    if (!scaler) throw InputError(file.string(), "has a pixel format without a way to RGB", "write it as yuv420p");
    converted = padded_frame(width, height, AV_PIX_FMT_RGB24);
    constexpr int kOne = 1 << 16;  // libswscale's fixed point
    sws_setColorspaceDetails(scaler.get(), sws_getCoefficients(coefficients), full, sws_getCoefficients(SWS_CS_DEFAULT),
                             1, 0, kOne, kOne);
  }
  // convert into padded rows and copy them without the padding
  rgb.width = width;
  rgb.height = height;
  rgb.channels = 3;
  rgb.pixels.resize(static_cast<std::size_t>(width) * height * 3);
  sws_scale(scaler.get(), frame->data, frame->linesize, 0, height, converted->data, converted->linesize);
  const std::size_t row = static_cast<std::size_t>(3) * width;
  for (int y = 0; y < height; ++y)
    std::memcpy(&rgb.pixels[y * row], converted->data[0] + static_cast<std::ptrdiff_t>(y) * converted->linesize[0],
                row);
}

namespace {

Decoder* open(const Path& file, int pipe, int threads) {
  // open the input and a decoder for it
  prepare();
  auto self = std::make_unique<Decoder>();
  self->file = file;
  self->input = open_recording(file, pipe);
  const AVCodecParameters& parameters = *self->input.video().codecpar;
  const AVCodec* codec = avcodec_find_decoder(parameters.codec_id);
  if (!codec)
    throw InputError(file.string(), std::string("no decoder for ") + avcodec_get_name(parameters.codec_id),
                     "write it as H.264");
  self->decoder.reset(avcodec_alloc_context3(codec));
  avcodec_parameters_to_context(self->decoder.get(), &parameters);
  self->decoder->thread_count = std::max(1, threads);
  self->decoder->max_pixels = kMostPixels;  // a damaged header may claim any size
  self->decoder->pkt_timebase = self->input.video().time_base;
  const int code = avcodec_open2(self->decoder.get(), codec, nullptr);
  if (code < 0) throw InputError(file.string(), "cannot be decoded (" + error_text(code) + ")", "write it as H.264");
  return self.release();
}

void close(Decoder* decoder) { delete decoder; }

bool next(Decoder& decoder, Image8* rgb) {
  if (!decoder.decode()) return false;
  if (rgb) decoder.convert(*rgb);
  ++decoder.frames;
  return true;
}

int frames(const Decoder& decoder) { return decoder.frames; }

double rate(const Decoder& decoder) { return claimed_rate(decoder.input.video()); }

double time(const Decoder& decoder) {
  const std::int64_t stamp = decoder.frame->best_effort_timestamp;
  if (stamp == AV_NOPTS_VALUE) return std::numeric_limits<double>::quiet_NaN();
  return static_cast<double>(stamp) * av_q2d(decoder.input.video().time_base);
}

VideoFacts video_facts(const Path& file) {
  prepare();
  Opened input = open_recording(file);
  const AVStream& video = input.video();
  VideoFacts facts;
  facts.width = video.codecpar->width;
  facts.height = video.codecpar->height;
  facts.rate = claimed_rate(video);
  Owned<AVPacket> packet(av_packet_alloc());
  while (facts.frames <= kMostFrames && av_read_frame(input.format.get(), packet.get()) >= 0) {
    if (packet->stream_index == input.stream && !(packet->flags & AV_PKT_FLAG_DISCARD)) ++facts.frames;
    av_packet_unref(packet.get());
  }
  return facts;
}

}  // namespace

// A video as it is written: H.264 in MP4 under a temporary name until it is finished.
struct Encoder {
  Path file, temporary;
  double rate = 0.0;
  int width = 0, height = 0, channels = 0;  // of the first frame
  std::int64_t count = 0;
  Owned<AVCodecContext> encoder;
  struct CloseOutput {
    void operator()(AVFormatContext* c) const {
      if (c->pb) avio_closep(&c->pb);
      avformat_free_context(c);
    }
  };
  std::unique_ptr<AVFormatContext, CloseOutput> output;
  AVStream* stream = nullptr;  // of `output`
  Owned<SwsContext> scaler;
  Owned<AVFrame> rgb;
  Owned<AVPacket> packet{av_packet_alloc()};

  [[noreturn]] void fail(const std::string& what, int code) const {
    throw WorkError(file.string(), what + (code < 0 ? " (" + error_text(code) + ")" : ""),
                    "check the folder, the free space and the encoders of libav");
  }
  void begin(const Image8& first);
  void drain();
};

// Chooses the encoder by the first frame and writes the file's header.
void Encoder::begin(const Image8& first) {
  width = first.width, height = first.height, channels = first.channels;
  // choose the encoder; the quality is visually close to lossless and keeps a camera's noise
  constexpr const char* kX264Quality = "16";
  constexpr int kMpeg4Quality = 3;
  const bool even = width % 2 == 0 && height % 2 == 0;
  const AVCodec* codec = avcodec_find_encoder_by_name("libx264");
  const bool x264 = codec != nullptr;
  if (!codec) codec = avcodec_find_encoder(AV_CODEC_ID_MPEG4);
  if (!codec) fail("no video encoder in libav", 0);
  if (!even && !x264) fail("an odd size needs libx264", 0);

  // set it up
  encoder.reset(avcodec_alloc_context3(codec));
  const AVRational frame_rate = av_d2q(rate, 1001000);
  encoder->width = width;
  encoder->height = height;
  encoder->pix_fmt = even ? AV_PIX_FMT_YUV420P : AV_PIX_FMT_YUV444P;  // chroma at half size needs even sizes
  encoder->time_base = av_inv_q(frame_rate);
  encoder->framerate = frame_rate;
  encoder->color_range = AVCOL_RANGE_MPEG;
  encoder->colorspace = AVCOL_SPC_SMPTE170M;  // BT.601
  encoder->color_primaries = AVCOL_PRI_SMPTE170M;
  encoder->color_trc = AVCOL_TRC_SMPTE170M;
  encoder->thread_count = 1;  // x264's output depends on the number of threads
  encoder->flags |= AV_CODEC_FLAG_GLOBAL_HEADER | AV_CODEC_FLAG_BITEXACT;
  if (x264) {
    av_opt_set(encoder->priv_data, "crf", kX264Quality, 0);
    av_opt_set(encoder->priv_data, "preset", "medium", 0);
    // x264's vector code for macroblock trees lets uninitialized memory influence the output; this path does not
    av_opt_set(encoder->priv_data, "x264-params", "cpu-independent=1", 0);
  } else {
    encoder->flags |= AV_CODEC_FLAG_QSCALE;
    encoder->global_quality = FF_QP2LAMBDA * kMpeg4Quality;
  }
  int code = avcodec_open2(encoder.get(), codec, nullptr);
  if (code < 0) fail("the encoder refuses", code);

  // open the file and write its header
  AVFormatContext* raw = nullptr;
  code = avformat_alloc_output_context2(&raw, nullptr, "mp4", temporary.c_str());
  if (code < 0) fail("no mp4 writer in libav", code);
  output.reset(raw);
  output->flags |= AVFMT_FLAG_BITEXACT;  // writes no version and no date
  stream = avformat_new_stream(raw, nullptr);
  stream->time_base = encoder->time_base;
  stream->avg_frame_rate = frame_rate;
  avcodec_parameters_from_context(stream->codecpar, encoder.get());
  code = avio_open(&raw->pb, temporary.c_str(), AVIO_FLAG_WRITE);
  if (code < 0) fail("cannot be opened for writing", code);
  code = avformat_write_header(raw, nullptr);
  if (code < 0) fail("writing failed", code);

  // the way from RGB
  const AVPixelFormat source = channels == 3 ? AV_PIX_FMT_RGB24 : AV_PIX_FMT_RGBA;
  scaler.reset(
      sws_getContext(width, height, source, width, height, encoder->pix_fmt, SWS_BICUBIC, nullptr, nullptr, nullptr));
  rgb = padded_frame(width, height, source);
  if (!scaler) fail("no way from RGB to the encoder's format", 0);
  constexpr int kOne = 1 << 16;
  sws_setColorspaceDetails(scaler.get(), sws_getCoefficients(SWS_CS_DEFAULT), 1, sws_getCoefficients(SWS_CS_ITU601), 0,
                           0, kOne, kOne);
}

// Writes what the encoder has ready.
void Encoder::drain() {
  for (;;) {
    int got = avcodec_receive_packet(encoder.get(), packet.get());
    if (got == AVERROR(EAGAIN) || got == AVERROR_EOF) return;
    if (got >= 0) {
      packet->stream_index = stream->index;
      packet->duration = 1;
      av_packet_rescale_ts(packet.get(), encoder->time_base, stream->time_base);
      got = av_interleaved_write_frame(output.get(), packet.get());
    }
    if (got < 0) fail("writing failed", got);
  }
}

namespace {

Encoder* create(const Path& file, double frame_rate) {
  prepare();
  CHAINSPLAT_CHECK(frame_rate > 0.0, file.string());
  auto self = std::make_unique<Encoder>();
  self->file = file;
  self->temporary = file.string() + ".tmp" + std::to_string(::getpid());
  self->rate = frame_rate;
  return self.release();
}

void add(Encoder& self, const Image8& frame) {
  CHAINSPLAT_CHECK(frame.width > 0 && frame.height > 0 && (frame.channels == 3 || frame.channels == 4) &&
                       frame.pixels.size() == static_cast<std::size_t>(frame.width) * frame.height * frame.channels,
                   "an RGB or RGBA picture");
  if (!self.encoder) self.begin(frame);
  CHAINSPLAT_CHECK(frame.width == self.width && frame.height == self.height && frame.channels == self.channels,
                   "frames of one size");
  // a new frame each time, because the encoder keeps references to earlier ones
  const Owned<AVFrame> picture = padded_frame(self.width, self.height, self.encoder->pix_fmt);
  picture->color_range = self.encoder->color_range;
  picture->colorspace = self.encoder->colorspace;
  const std::size_t row = static_cast<std::size_t>(frame.channels) * self.width;
  for (int y = 0; y < self.height; ++y)
    std::memcpy(self.rgb->data[0] + static_cast<std::ptrdiff_t>(y) * self.rgb->linesize[0], &frame.pixels[y * row],
                row);
  sws_scale(self.scaler.get(), self.rgb->data, self.rgb->linesize, 0, self.height, picture->data, picture->linesize);
  picture->pts = self.count++;
  const int code = avcodec_send_frame(self.encoder.get(), picture.get());
  if (code < 0) self.fail("encoding failed", code);
  self.drain();
}

// Flushes the encoder, closes the file and gives it its name.
void finish(Encoder& self) {
  CHAINSPLAT_CHECK(self.count > 0, self.file.string());
  int code = avcodec_send_frame(self.encoder.get(), nullptr);
  if (code < 0) self.fail("encoding failed", code);
  self.drain();
  code = av_write_trailer(self.output.get());
  if (code >= 0) code = avio_closep(&self.output->pb);
  if (code < 0) self.fail("writing failed", code);
  self.output.reset();
  std::error_code error;
  std::filesystem::rename(self.temporary, self.file, error);
  if (error) self.fail("renaming failed (" + error.message() + ")", 0);
  self.temporary.clear();
}

void discard(Encoder* self) {
  self->output.reset();
  if (!self->temporary.empty()) ::unlink(self->temporary.c_str());
  delete self;
}

}  // namespace

const VideoLibrary chainsplat_videos = {.version = CHAINSPLAT_VERSION,
                                        .open = open,
                                        .close = close,
                                        .next = next,
                                        .frames = frames,
                                        .rate = rate,
                                        .time = time,
                                        .video_facts = video_facts,
                                        .create = create,
                                        .add = add,
                                        .finish = finish,
                                        .discard = discard};

}  // namespace chainsplat::capture::media
