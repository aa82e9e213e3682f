"""Lists the operators of foreign programs: on tensors, numbers, texts and lists; they compute and touch nothing else.

Whatever is absent is refused by its name. Absent on purpose: what opens files (``from_file``, ``save``), starts tasks or calls
other machines, reaches into memory without checking (``set_``, ``resize_``, ``as_strided``, ``empty_strided``, and
``native_batch_norm`` and ``upsample_*``, which take sizes on trust), or comes from elsewhere than torch's and ONNX's own sets.
"""

from __future__ import annotations


def _names(text: str) -> frozenset[str]:
    return frozenset(text.split())


_ELEMENTWISE = """
abs absolute acos acosh add addcdiv addcmul angle arccos arccosh arcsin arcsinh arctan arctan2 arctanh asin asinh atan atan2
atanh bitwise_and bitwise_left_shift bitwise_not bitwise_or bitwise_right_shift bitwise_xor ceil celu clamp clamp_max clamp_min
clip copysign cos cosh deg2rad digamma div divide dropout elu eq erf erfc erfinv exp exp2 expm1 fill fix float_power floor
floor_divide fmax fmin fmod frac gcd ge gelu greater greater_equal gt hardshrink hardsigmoid hardswish hardtanh heaviside hypot
i0 lcm ldexp le leaky_relu lerp less less_equal lgamma log log10 log1p log2 logaddexp logaddexp2 logical_and logical_not
logical_or logical_xor logit lt masked_fill maximum minimum mish mul multiply nan_to_num ne neg negative nextafter not_equal
polygamma pow prelu rad2deg reciprocal relu relu6 remainder round rrelu rsqrt rsub selu sgn sigmoid sign signbit silu sin sinc
sinh softplus softshrink sqrt square sub subtract tan tanh threshold true_divide trunc xlogy zero alpha_dropout feature_dropout
squeeze unsqueeze transpose t swapaxes swapdims index_add index_copy index_fill index_put scatter scatter_add masked_scatter
bernoulli normal uniform exponential random copy detach requires_grad squeeze_ unsqueeze_ fill_diagonal tril triu cumsum cumprod
"""
"""Those of these that exist with an underscore behind, in place, may be used in that form as well."""

_OTHER = """
adaptive_avg_pool1d adaptive_avg_pool2d adaptive_avg_pool3d adaptive_max_pool1d adaptive_max_pool2d addbmm addmm addmv addr
adjoint alias all allclose amax amin aminmax any arange argmax argmin argsort argwhere as_tensor atleast_1d atleast_2d
atleast_3d avg_pool1d avg_pool2d avg_pool3d baddbmm batch_norm bilinear block_diag bmm broadcast_tensors broadcast_to bucketize
cartesian_prod cat cdist chain_matmul channel_shuffle cholesky chunk clone column_stack complex concat concatenate
constant_pad_nd contiguous conv1d conv2d conv3d conv_transpose1d conv_transpose2d conv_transpose3d convolution _convolution
corrcoef cosine_similarity count_nonzero cov cross cummax cummin diag diag_embed diagflat diagonal diff dim dist dot dsplit
dstack einsum embedding empty empty_like equal expand expand_as eye flatten flip fliplr flipud frobenius_norm frexp full
full_like gather glu group_norm gru gru_cell hsplit hstack imag index index_select inner instance_norm inverse is_complex
is_floating_point is_nonzero is_same_size is_signed isclose isfinite isin isinf isnan isneginf isposinf isreal item kron
kthvalue layer_norm linalg_cross linalg_det linalg_eigh linalg_inv linalg_lstsq linalg_matrix_norm linalg_multi_dot linalg_norm
linalg_pinv linalg_qr linalg_solve linalg_svd linalg_vecdot linalg_vector_norm linear linspace log_sigmoid log_softmax
logcumsumexp logspace logsumexp lstm lstm_cell masked_select matmul matrix_exp matrix_power max max_pool1d max_pool2d
max_pool3d mean median meshgrid min mm mode movedim moveaxis multinomial mv nanmean nanmedian nansum narrow
native_dropout native_group_norm native_layer_norm native_norm new_empty new_full new_ones new_zeros nonzero norm numel
numpy_T one_hot ones ones_like outer pad pairwise_distance permute pinverse pixel_shuffle pixel_unshuffle positive prod rand
rand_like randint randint_like randn randn_like randperm range ravel real reflection_pad1d reflection_pad2d reflection_pad3d
repeat repeat_interleave replication_pad1d replication_pad2d replication_pad3d reshape reshape_as resolve_conj resolve_neg
rms_norm rnn_relu rnn_relu_cell rnn_tanh rnn_tanh_cell roll rot90 row_stack scalar_tensor scaled_dot_product_attention
scatter_reduce searchsorted select select_scatter size slice slice_scatter softmax sort split split_with_sizes stack std
std_mean stride sum sum_to_size svd take take_along_dim tensor_split tensordot tile to topk trace trapezoid trapz tril_indices
triu_indices type_as unbind unflatten unfold unique_consecutive unique_dim unsafe_chunk unsafe_split vander var var_mean vdot
view view_as view_as_complex view_as_real vsplit vstack where zeros zeros_like _cast_Float _cast_Double _cast_Int _cast_Long
_softmax _log_softmax _unique2 _weight_norm _reshape_from_tensor _shape_as_tensor
lift_fresh mT mH matrix_H get_device is_inference is_contiguous is_grad_enabled storage_offset element_size cpu result_type
can_cast promote_types
"""

_PLAIN = """
Bool BoolImplicit Complex Delete Float FloatImplicit Int IntImplicit Scalar ScalarImplicit __and__ __contains__ __derive_index
__getitem__ __is__ __isnot__ __not__ __or__ __range_length __round_to_zero_floordiv __xor__ __lshift__ __rshift__ _set_item
append bin bool capitalize chr clear count degrees dict divmod endswith extend fabs factorial find float floordiv format get
hex index insert int isalnum isalpha isdigit isinf isnan items join keys len list lower lstrip mathremainder modf oct ord pop
popitem radians replace reverse rstrip setdefault sorted split splitlines startswith str strip tensor title tuple update upper
values warn wait_never is_scripting has_torch_function percentFormat neg pow add mul sub truediv abs ceil floor round copy
remove hash set_grad_enabled _infer_size _size_if_not_equal _unwrap_optional _grad_sum_to_size device isfinite gamma
"""

TORCH_OPERATORS = frozenset(
    {*_ELEMENTWISE.split(), *(f"{name}_" for name in _ELEMENTWISE.split()), *_OTHER.split(), *_PLAIN.split()}
)
"""Operators of torch's own set, ``aten``."""

RECURRENT = frozenset({"gru", "lstm", "rnn_relu", "rnn_tanh"})
"""Operators with a form for packed sequences, whose ``batch_sizes`` torch believes and reads beyond its memory: that form is refused."""

PRIM_OPERATORS = _names("""
BroadcastSizes CallFunction CallMethod ChunkSizes Closure Constant ConstantChunk CreateObject DictConstruct Enter EnumName
EnumValue Exit GetAttr If ListConstruct ListUnpack Loop ModuleContainerIndex NumToTensor Param Print RaiseException
ReductionSizes Return SetAttr StringIndex TimePoint TupleConstruct TupleIndex TupleSlice TupleUnpack Uninitialized abs
annotate data device dtype grad index is_cpu is_cuda is_meta is_mkldnn is_mps is_nested is_quantized is_sparse is_sparse_csr
is_vulkan is_xla is_xpu isinstance itemsize layout max min name nbytes rangelist requires_grad shape tolist type
unchecked_cast unchecked_unwrap_optional
""")
"""Operators of TorchScript itself: control flow, attributes, numbers."""

_QUANTIZED = """
linear_dynamic linear_dynamic_fp16 linear_prepack linear_prepack_fp16 linear_relu_dynamic linear_unpack linear_unpack_fp16
"""

OPERATORS = {"aten": TORCH_OPERATORS, "prim": PRIM_OPERATORS, "quantized": frozenset(_QUANTIZED.split())}
"""Operators of TorchScript by their set; the last are those of linear layers with weights of eight bits."""

PYTHON_NAMES = _names("""
AssertionError BaseException Exception IndexError KeyError NotImplementedError RuntimeError TypeError ValueError abs all
annotate any bool chr complex dict divmod enumerate float format getattr hasattr hash hex int isinstance len list max min oct
ord pow print range reversed round sorted str sum tuple unchecked_cast uninitialized zip
""")
"""Functions that TorchScript code calls by a bare name."""

ONNX_OPERATORS = _names("""
Abs Acos Acosh Add And ArgMax ArgMin Asin Asinh Atan Atanh Attention AveragePool BatchNormalization Bernoulli BitShift
BitwiseAnd BitwiseNot BitwiseOr BitwiseXor BlackmanWindow Cast CastLike Ceil Celu CenterCropPad Clip Compress Concat
ConcatFromSequence Constant ConstantOfShape Conv ConvInteger ConvTranspose Cos Cosh CumSum DepthToSpace DequantizeLinear Det
Div Dropout DynamicQuantizeLinear Einsum Elu Equal Erf Exp Expand EyeLike Flatten Floor GRU Gather GatherElements GatherND
Gelu Gemm GlobalAveragePool GlobalLpPool GlobalMaxPool Greater GreaterOrEqual GridSample GroupNormalization HammingWindow
HannWindow HardSigmoid HardSwish Hardmax Identity If InstanceNormalization IsInf IsNaN LRN LSTM LayerNormalization LeakyRelu
Less LessOrEqual Log LogSoftmax Loop LpNormalization LpPool MatMul MatMulInteger Max MaxPool Mean MeanVarianceNormalization
Min Mish Mod Mul Multinomial Neg NonZero Not OneHot Optional OptionalGetElement OptionalHasElement Or PRelu Pad Pow
QLinearConv QLinearMatMul QuantizeLinear RMSNormalization RNN RandomNormal RandomNormalLike RandomUniform RandomUniformLike
Range Reciprocal ReduceL1 ReduceL2 ReduceLogSum ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum
ReduceSumSquare Relu Reshape Resize ReverseSequence RotaryEmbedding Round Scan Scatter ScatterElements ScatterND Selu
SequenceAt SequenceConstruct SequenceEmpty SequenceErase SequenceInsert SequenceLength Shape Shrink Sigmoid Sign Sin Sinh Size
Slice Softmax Softplus Softsign SpaceToDepth Split SplitToSequence Sqrt Squeeze Sub Sum Swish Tan Tanh ThresholdedRelu Tile
TopK Transpose Trilu Unique Unsqueeze Upsample Where Xor
""")
"""Operators of ONNX's own set."""

ONNX_CONTRIBUTED = _names("""
BiasGelu DynamicQuantizeMatMul FastGelu FusedConv FusedGemm FusedMatMul Gelu LayerNormalization MatMulIntegerToFloat QuickGelu
SimplifiedLayerNormalization SkipLayerNormalization SkipSimplifiedLayerNormalization TransposeMatMul
""")
"""Operators that onnxruntime's own optimizer writes, domain ``com.microsoft``."""
